"""Implicit branch: encodings, decoders, ray rendering, losses."""
