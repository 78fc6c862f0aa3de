"""Presets, as package data: `default.toml`, `demo.toml`, `paper.toml`, ..."""
