"""The subproblems of SQP: what they are, the units they are solved in, and the routes that solve them."""
