"""A folder of pictures as a gallery that is searched with pictures: the entry to the library.

It imports `drawing` and the packages below it.
"""

from lpn.library.answer import Answer, NamedMatch, PairPicture
from lpn.library.gallery import Gallery

__all__ = ["Answer", "Gallery", "NamedMatch", "PairPicture"]
