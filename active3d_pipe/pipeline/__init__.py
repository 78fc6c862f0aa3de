"""The engine: configuration, run folder, atomic artifacts, keys, journal, lock and the loop. It knows no 3D."""
