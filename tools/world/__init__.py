"""A procedural city: planned with NumPy, rendered with Blender, written in University-1652's layout; `python -m tools.world`.

`plan` places everything, `cameras` defines the views, `paint` and `meshes` describe the appearance as arrays; only `render`
needs the package bpy. `build` and `flight` render what is missing. The package imports `lpn`, and nothing else of `tools`.
"""
