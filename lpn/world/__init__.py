"""A procedural city: planned with NumPy, rendered with Blender, written in University-1652's layout.

`plan` places everything, `cameras` defines the views, `paint` and `meshes` describe the appearance as arrays; only `render`
needs the package bpy (extra `world`). `build` runs them in resumable batches. The package imports `datasets` and the packages
below it; `reproduce` and `cli` import it.
"""
