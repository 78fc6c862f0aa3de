"""Policies: who decides where to look next. All of them share map, camera, motion, free space, path and safety.

`registry.py` lists them, `context.py` is what a policy sees, `base.py` what most of them are made of. One file each.
"""
