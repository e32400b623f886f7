"""Ta's linear graphs: subproblems as factors over tangent steps, solved by variable elimination."""
