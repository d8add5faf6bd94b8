"""A task: queries, their gallery, and their truth, whatever they were opened from; with outcomes, positions, and notes.

`Task` is what every command and the explorer work on. `GalleryTask` holds its gallery in memory; a task over an index is
`lpn.index.task.IndexTask`.
"""
