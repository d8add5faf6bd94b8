"""The command describe."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.views import View
from lpn.sources import Advanced, ModelOptions

if TYPE_CHECKING:
    from lpn.descriptors import Store
    from lpn.models.base import Model

_FOR_RAY = ("address", "workers", "threads", "part", "positions")


@dataclass(kw_only=True)
class GatherParts:
    """Make a store of descriptors on this machine from the parts that --engine ray wrote."""

    parts: str
    """Folder or address of the parts."""
    out: Path
    """Folder of the store; its rows are in order of the pictures' names."""

    def run(self) -> None:
        from lpn.cluster.parts import BROKEN, open_parts, to_store

        parts = open_parts(self.parts)
        store = to_store(parts, self.out)
        shape = " x ".join(map(str, store.descriptors.shape))
        print(f"{self.out} holds {shape} numbers: pictures x parts x dimensions.")
        if parts.broken:
            print(f"{len(parts.broken):,} pictures are broken and not in it; {BROKEN} in {self.parts} names them.")

    def resume_hint(self) -> str:
        """Return how to resume after a stop."""
        return f"What {self.out} has by now is kept; the same command goes on."


@dataclass(kw_only=True)
class DescribeCommand(ModelOptions):
    """Describe pictures, or windows of a map, into descriptors on disk; resumable.

    With --engine ray it describes on many machines, into parts, of which lpn describe --parts PARTS --out STORE makes a store.
    """

    MODES: ClassVar[dict[str, type[GatherParts]]] = {"--parts": GatherParts}

    model: Path = field()  # no default, unlike that of `ModelOptions`
    """Trained LPN: .onnx, .safetensors, or .pth; with --engine ray an .onnx, which is sent to the workers."""
    out: str
    """Folder of the store; with --engine ray folder or address of the parts, which every machine must see."""
    images: str | None = None
    """Folder of pictures, searched with all folders below it; with --engine ray also an address such as s3://bucket/tiles."""
    map: Path | None = None
    """Map whose windows are described in place of pictures: a folder of lpn map, or a georeferenced picture."""
    view: View | None = None
    """The view the pictures show; of a map satellite by default."""
    role: Advanced[Literal["query", "gallery"] | None] = None
    """Role of the pictures, for a model with one branch for queries and one for the gallery; by default the satellite is the
    gallery. An index holds a gallery."""
    size: Advanced[tuple[float, ...]] = ()
    """With --map: sides of the windows in metres, such as 70 100 140; by default five, of up to 300 m or 0.6 of the map."""
    overlap: Advanced[float | None] = None
    """With --map: share of a window's side that its neighbour covers, too; 0.5 by default."""
    precision: Literal["float32", "float16", "int8"] = "float32"
    """Numbers on disk; float16 halves the store, int8 quarters it (not with --engine ray)."""
    engine: Literal["local", "ray"] = "local"
    """local describes on this machine, and refuses broken pictures before anything is computed. ray describes with many workers,
    lists broken pictures in broken.csv, and ends with status 1 if there are any."""
    address: Advanced[str | None] = None
    """With --engine ray: address of the cluster, auto on one of its machines; by default workers run on this machine."""
    workers: Advanced[int | None] = None
    """With --engine ray: number of workers; by default as many as the cores allow."""
    threads: Advanced[int | None] = None
    """With --engine ray: cores of one worker, 1 by default; each worker holds the model once, so more cores save memory."""
    part: Advanced[int | None] = None
    """With --engine ray: pictures of one part, which a killed worker loses; 256 by default."""
    positions: Advanced[str | None] = None
    """With --engine ray: file of positions in the format of geo.csv, with paths relative to --images or a folder above it; by
    default geo.csv among the pictures, if any."""

    def run(self) -> int:
        return self._parts() if self.engine == "ray" else self._store()

    def resume_hint(self) -> str:
        """Return how to resume after a stop."""
        return f"What {self.out} has by now is kept; the same command goes on."

    def _store(self) -> int:
        from lpn import descriptors

        if options := [name for name in _FOR_RAY if getattr(self, name) is not None]:
            raise InputError(f"--{options[0]} is for many workers; give it with --engine ray.")
        if "://" in (self.images or "") + self.out:
            raise InputError("Only --engine ray reads and writes addresses; give folders, or --engine ray.")
        if self.map is not None:
            return self._windows(self.map)
        images, view = self._pictures()
        model, root, out = self._model(view), Path(images), Path(self.out)
        files = descriptors.pictures_below(root)
        self._report(descriptors.describe(model, files, view, out, root=root, precision=self.precision), model)
        return 0

    def _windows(self, where: Path) -> int:
        from lpn.flight.locate.retrieval import describe_windows, pyramid_sizes
        from lpn.flight.maps import NamedWindow, open_map

        if self.images is not None:
            raise InputError("A map's windows are described in place of pictures; give either --map or --images.")
        view = self.view or "satellite"
        model, basemap = self._model(view), open_map(where)
        sizes = self.size or pyramid_sizes(basemap, [])
        windows = basemap.pyramid(sizes, 0.5 if self.overlap is None else self.overlap)
        if not windows:
            raise InputError(
                f"No window of {min(sizes):.0f} m or more fits on the map {printable(basemap.name)}; give smaller ones as --size."
            )
        named = NamedWindow.all_of(windows, basemap.frame)
        rounded, names = NamedWindow.all_on(named, basemap.frame), [window.name for window in named]
        store = describe_windows(model, basemap, rounded, self.out, view, self.precision, names)
        self._report(store, model, "windows")
        return 0

    def _model(self, view: View) -> Model:
        return self.load().in_role(view, self.role)

    def _report(self, store: Store, model: Model, rows: str = "pictures") -> None:
        shape = " x ".join(map(str, store.descriptors.shape))
        print(f"{self.out} holds {shape} numbers: {rows} x parts x dimensions. Computed on {model.device}.")

    def _pictures(self) -> tuple[str, View]:
        """Return the noun for the described pictures, and their view."""
        if self.images is None:
            raise InputError("There are no pictures to describe; give a folder as --images, or a map as --map.")
        if self.view is None:
            raise InputError("The view of the pictures is not given; give --view satellite, drone, or street.")
        if self.size or self.overlap is not None:
            raise InputError("Pictures have no windows; give --size and --overlap with --map only.")
        return self.images, self.view

    def _parts(self) -> int:
        from lpn.cluster.driver import describe_parts
        from lpn.cluster.parts import BROKEN

        if self.map is not None:
            raise InputError("Windows of a map are described on one machine; leave --engine ray out.")
        images, view = self._pictures()
        if self.provider not in ("auto", "cpu"):
            raise InputError("Ray's workers compute on the CPU; leave --provider or --engine ray out.")
        if self.kind is not None or self.pooling is not None:
            option = "kind" if self.kind is not None else "pooling"
            raise InputError(f"Ray's workers take an .onnx, which contains its {option}; leave --{option} out.")
        if self.precision == "int8":
            raise InputError("Parts hold float32 or float16; give one of these as --precision.")
        summary = describe_parts(
            self.model,
            images,
            view,
            self.out,
            precision=self.precision,
            address=self.address,
            workers=self.workers,
            threads=1 if self.threads is None else self.threads,
            size=self.part,
            positions=self.positions,
            role=self.role,
            say=lambda line: print(line, flush=True),
        )
        broken = len(summary.broken)
        print(f"{self.out} holds {summary.pictures - broken:,} descriptors, {summary.computed:,} of them computed now.")
        if broken:
            print(f"{broken:,} pictures could not be described; {BROKEN} there names them, each with the reason.")
        return 1 if broken else 0
