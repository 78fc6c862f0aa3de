"""Entropy and expected information gain, shared by keyframe choice and planning."""
