"""Published models of other methods than LPN, and networks whose tokens are pooled by name.

A method is one file in `methods`, or in another package that names it by an entry point of the group `lpn.adapters`. It states
the entries that it needs (`registry.Adapter`), and builds branches that describe pictures as the released test code does, with
an account of every part (`lpn.models.contract`). Only this module needs no torch. Networks of timm also need timm.
"""

# The name of a method, such as "dac"; `registry.adapters` has them.
Kind = str

__all__ = ["Kind"]
