"""Published models of other methods than LPN, and networks whose tokens are pooled by name.

A method is one file in `methods`, or in another package that names it by an entry point of the group `lpn.adapters`: it states
the entries that it needs (`registry.Adapter`), and builds branches with an account of every part (`lpn.models.contract`) that
describe pictures as the released test code does. This face needs no torch; the rest does, and timm where a network is timm's.
"""

# The name of a method, such as "dac"; `registry.adapters` has them.
Kind = str

__all__ = ["Kind"]
