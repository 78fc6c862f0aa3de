"""Metrics and protocols by which a reconstruction is judged against ground truth."""
