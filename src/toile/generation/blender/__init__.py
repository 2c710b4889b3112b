"""Scenes from Blender's cloth and Cycles: a generator that shares neither solver nor renderer with the fits.

``bpy`` is a whole program in one module, with one state per process, so only ``engine`` imports it, and that
runs in a process of its own. This package imports nothing, so that the process needs bpy and NumPy alone.
"""
