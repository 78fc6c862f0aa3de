"""The hierarchical uncertainty volume: evidence, three terms, fusion, entropies (sec. uncertainty_map)."""
