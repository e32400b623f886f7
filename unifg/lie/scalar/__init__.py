"""The groups for compiled code: functions on one element at a time, which write their result.

One module per group, with the names of the group's methods: ``exp(d, out)``, ``log(x, out)``,
``compose(x, y, out)``, ``inverse(x, out)``, ``between(x, y, out)``, ``retract(x, d, out)``, ``local(x, y, out)``,
``act(x, p, out)``, ``matrix(x, out)``, ``adjoint(x, out)``, ``right_jacobian(d, out)``,
``right_jacobian_inverse(d, out)``, ``left_jacobian(d, out)``, ``left_jacobian_inverse(d, out)``. Arguments are float64
arrays, one-dimensional except for the (n, n) results; every entry of ``out`` is written and nothing is allocated or
checked. All arguments are read before the first result is written, so a result may take the place of an argument.

The batched methods of the groups are loops over these functions.
"""
