"""Tables and figures of the four papers, computed again beside the printed numbers: ``unifg reproduce``."""
