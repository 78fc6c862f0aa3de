"""The stages: thin, each reads artifacts, calls one room, writes artifacts."""
