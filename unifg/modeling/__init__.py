"""Model of a problem: variables, terms, residuals, the graph."""
