"""A procedural city: planned with numpy, rendered with Blender, written in University-1652's layout.

`plan` says where everything stands, `cameras` from where it is seen, `paint` and `meshes` what it looks like as arrays;
only `render` needs the package bpy (extra `world`). `build` runs them in batches that can be resumed.
"""
