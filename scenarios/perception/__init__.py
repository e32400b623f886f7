"""What measurements say about things that no map shows."""
