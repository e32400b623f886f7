"""From a plain function to machine code with exact derivatives: trace, differentiate, emit."""
