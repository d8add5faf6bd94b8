"""One connected browser.

`session` keeps its state and analyses it, `views` builds what its page shows and draws an analysis there, `address` reads and
writes the page's address, `messages` are those of the page itself, and `services` are shared by all browsers of a workspace.
"""
