"""Tools of the developers of unifg, started with ``python -m tools.<name>`` from the checkout; never installed."""

import benchmarks  # noqa: F401 - one thread a process, and the problems of the tests within reach
