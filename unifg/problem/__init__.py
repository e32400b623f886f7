"""From a statement to numbers: one table of terms, compiled passes, sparsity, values."""
