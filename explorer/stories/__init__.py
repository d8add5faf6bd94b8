"""Stories: states of a page, kept step by step with captions, edited, told, saved, and exported.

`story` and `messages` are pure, `library` reads and saves the stories of a workspace, `tour` builds the one that every workspace
has, and `window` shows them. `exported` renders one as a file that needs no server, with pictures of `windows`, `ground`, and
`map_picture`. Only `explorer.client` imports this package.
"""
