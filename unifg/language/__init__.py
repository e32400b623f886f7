"""What a user states: variables, terms, residuals, the graph."""
