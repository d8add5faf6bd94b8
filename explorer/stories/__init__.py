"""Stories: states of a page, kept step by step with captions, told, saved, and exported.

`story` and `messages` are pure, `library` reads and saves the stories of a workspace, `tour` builds the one that every workspace
has, and `telling` keeps steps and tells. `exported` renders a story as a file that needs no server. Only `explorer.client`
imports this package.
"""
