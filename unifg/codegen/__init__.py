"""The machine beneath: compiled functions, their addresses, vector units and links between them."""
