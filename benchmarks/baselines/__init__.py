"""Published local planners, written from their papers, to compare with."""
