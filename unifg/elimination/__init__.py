"""Elimination of variables from block-sparse symmetric systems."""
