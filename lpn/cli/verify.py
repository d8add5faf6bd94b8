"""The command verify: comparison of files with their checksums."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass
class VerifyCommand:
    """Compare stores, indexes, shards, models, and trainings with their checksums; status 1: one is damaged or empty."""

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Files and folders, searched recursively; by default the cache of descriptors."""

    def run(self) -> int:
        from lpn.core.files import cache_folder, printable
        from lpn.doctor.verify import verify

        damaged = 0
        for path in self.paths or (cache_folder(),):
            for verdict in verify(path):
                damaged += not verdict.whole
                name = printable(str(verdict.path))
                if verdict.whole:
                    print(f"{name} {verdict.message}.")
                else:
                    print(
                        f"EMPTY: {name} {verdict.message}" if verdict.empty else f"DAMAGED: {name}: {verdict.message}"
                    )
        return 1 if damaged else 0
