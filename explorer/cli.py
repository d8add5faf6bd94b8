"""The command that opens the app: explore. The entry point group `lpn.commands` makes it a command of `lpn`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from lpn.core.demo import DEMO, DEMO_BASELINE, DEMO_FLIGHT, DEMO_MODEL, DEMO_QUERY
from lpn.core.errors import InputError
from lpn.core.resources import ProviderName
from lpn.models.adapters import Kind

if TYPE_CHECKING:
    from explorer.server.auth import Authenticator
    from explorer.workspace import LazyWorkspace, Workspace
    from lpn.core.served_page import ServedPage


@dataclass
class Explore:
    """Open the explorer in a browser."""

    # The command runs until it is stopped, so a stop is no failure.
    SERVES: ClassVar[bool] = True
    data: Path | None = None
    """Data set in any layout of docs/data.md, of which the test split is shown; by default the demo."""
    model: Path | None = None
    """Trained LPN: .onnx (needs no torch), .safetensors, a published .pth, or a name of lpn models; by default the demo's."""
    kind: Kind | None = None
    """Method of a published .pth whose entries do not tell it, such as dac; see docs/models.md."""
    map: Path | None = None
    """Map under a flight: a folder of lpn map, or a georeferenced picture; needs --flight and --model."""
    flight: Path | None = None
    """Flight over the map: a folder of lpn flight, or one of photos; its frames are the queries."""
    register: bool = True
    """Lay each photo of the flight over the map; this goes on in the background, and its answers are kept."""
    index: str | None = None
    """Index of tiles to search, made by lpn index: a folder, or milvus://host:port/collection; needs --model, and queries by
    --data, --query FOLDER, or --map with --flight."""
    depth: int | None = None
    """With --index: number of tiles that a search returns, 100 by default; ranks beyond it are not known."""
    beside: Path | None = None
    """Second trained model to compare on every query (key Y, tab Two models), such as one with other parts."""
    beside_kind: Kind | None = None
    """Method of --beside, as --kind is that of --model."""
    provider: ProviderName = "auto"
    """Provider: auto (LPN_PROVIDER, else a GPU if one works, else the CPU), cpu, cuda, or, for an .onnx, tensorrt."""
    calibrate: bool = False
    """Choose the zoom at which drone pictures and tiles show the same ground, and subtract each view's mean, without labels; see
    docs/evaluation.md."""
    gallery: Path | None = None
    """Descriptors of a gallery that any model made, as .npy, .npz, .mat, or .parquet; needs --query with those of the queries,
    and no model."""
    paths: Path | None = None
    """With --gallery: list of the pictures, a .csv with file, side, label, latitude, longitude (docs/data.md)."""
    order: Literal["parts-first", "parts-last"] = "parts-first"
    """With --gallery: parts-first for arrays (N, n, D), parts-last for (N, D, n)."""
    saved: Path | None = None
    """Result of the published test code, pytorch_result.mat, to explore in place of a model; needs --data."""
    n_parts: int | None = None
    """Number of parts of the descriptors in --saved, or in two-dimensional --gallery and --query; 1 by default."""
    query: str | None = None
    """Name of the query to open with, as the picker shows it, by default the first; with --index also a folder of pictures to
    search for; with --gallery the file of the queries' descriptors."""
    host: str = "127.0.0.1"
    """Address to listen on; on any other than 127.0.0.1, other machines can connect with the token in the printed link."""
    port: int = 8080
    """Port to listen on."""
    token: str | None = None
    """Token to ask for, at least 12 characters; other users see it in the list of processes, so better set LPN_TOKEN."""
    ask_token: bool = False
    """Ask for a token on 127.0.0.1 too; otherwise other users of this machine can connect without one."""
    allow_host: tuple[str, ...] = ()
    """Further host names of the page, such as that of a reverse proxy (docs/serving.md)."""

    def run(self) -> None:
        from explorer.app import serve

        authenticator = self._authenticator()
        open_workspace, offered = self._workspaces()
        serve(open_workspace, self.host, self.port, authenticator, offered)

    def run_in_background(self) -> ServedPage:
        """Serve until the page is closed or the process ends; a port of 0 is any that is free."""
        from explorer.app import serve_in_background

        authenticator = self._authenticator()
        open_workspace, offered = self._workspaces()
        return serve_in_background(open_workspace, self.host, self.port, authenticator, offered)

    def _authenticator(self) -> Authenticator:
        from explorer.server.auth import make_authenticator

        return make_authenticator(self.host or "0.0.0.0", self.token, self.ask_token, self.allow_host)

    def _workspaces(self) -> tuple[Callable[[], Workspace], dict[str, LazyWorkspace]]:
        """Return what opens the page's data, and further workspaces that the page offers, by the keys of their addresses."""
        from explorer.opening import offered_flight, open_model, open_saved
        from lpn.retrieval.published_results import check_n_parts, load_saved

        if self.kind is not None and self.model is None:
            raise InputError("A kind is that of a model; give --kind with --model, or leave it out.")
        if self.beside_kind is not None and self.beside is None:
            raise InputError(
                "This kind is that of the second model; give --beside-kind with --beside, or leave it out."
            )
        if self.calibrate and any(
            other is not None for other in (self.index, self.gallery, self.map, self.flight, self.saved)
        ):
            raise InputError(
                "A calibration describes the pictures of a data set by a model; give --calibrate with --data and --model, and "
                "leave it out with an index, arrays, a flight, or a saved result."
            )
        if self.index is not None:
            return self._index(self.index), {}
        if self.gallery is not None:
            return self._arrays(self.gallery), {}
        if self.paths is not None or self.order != "parts-first":
            raise InputError(
                "A list of pictures and an order belong to plain arrays; give --gallery and --query with --paths and --order."
            )
        if self.depth is not None:
            raise InputError("A gallery in memory is ranked in full; give --depth with --index only.")
        if self.map is not None or self.flight is not None:
            return self._flight(), {}
        if not self.register:
            raise InputError("Only photos of a flight are registered; give --no-register with --map and --flight.")
        if self.saved is not None:
            if self.data is None or self.model is not None or self.beside is not None:
                raise InputError(
                    "A saved result is explored with its data set and without a model; give --saved and --data."
                )
            if self.provider != "auto":
                raise InputError("A saved result needs no network; leave --provider out.")
            saved = partial(load_saved, self.saved, check_n_parts(self.n_parts))
            data = self.data
            return lambda: open_saved(data, saved(), self.query), {}
        if self.n_parts is not None:
            raise InputError("A model knows its number of parts; give --n-parts with --saved only.")
        if self.data is not None and self.model is None:
            raise InputError(f"There is no model for {self.data}; give a trained LPN with --model.")
        if self.data is None and not DEMO.is_dir():
            raise InputError(
                "The demo's files are missing from this installation; install lpn-explorer again, or give a data set with "
                "--data and a model with --model."
            )
        query = DEMO_QUERY if self.data is None and self.query is None else self.query
        is_demo = self.data is None and self.model is None
        baseline = DEMO_BASELINE if is_demo and DEMO_BASELINE.is_file() else None
        flight = is_demo and DEMO_FLIGHT[0].is_file()
        others = {"flight": offered_flight(*DEMO_FLIGHT, DEMO_MODEL, self.provider)} if flight else {}
        return partial(
            open_model,
            self.data or DEMO,
            self.model or DEMO_MODEL,
            query,
            self.beside,
            baseline,
            self.provider,
            self.kind,
            self.beside_kind,
            self.calibrate,
        ), others

    def _arrays(self, gallery: Path) -> Callable[[], Workspace]:
        from explorer.opening import open_arrays
        from lpn.retrieval.plain_arrays import load_arrays
        from lpn.retrieval.published_results import check_n_parts

        if self.query is None:
            raise InputError(
                "Plain arrays have two sides; give the descriptors of the queries as --query beside --gallery."
            )
        others = {"--model": self.model, "--saved": self.saved, "--beside": self.beside, "--depth": self.depth}
        others |= {"--map": self.map, "--flight": self.flight}
        if other := next((name for name, value in others.items() if value is not None), None):
            raise InputError(f"Plain arrays are explored without a model, by their rows alone; leave {other} out.")
        if self.provider != "auto" or not self.register:
            raise InputError("Plain arrays need no network; leave --provider and --no-register out.")
        query, n_parts = Path(self.query), None if self.n_parts is None else check_n_parts(self.n_parts)
        load = partial(load_arrays, query, gallery, self.paths, n_parts, self.order, self.data)
        return lambda: open_arrays(load(), query.name)

    def _index(self, where: str) -> Callable[[], Workspace]:
        from explorer.opening import open_indexed
        from lpn.index.task import DEPTH

        if self.model is None:
            raise InputError("An index is searched with the model that described its tiles; give it as --model.")
        others = {"--saved": self.saved, "--n-parts": self.n_parts, "--beside": self.beside}
        others |= {"--gallery": self.gallery, "--paths": self.paths}
        if other := next((name for name, value in others.items() if value is not None), None):
            raise InputError(f"An index holds descriptors of one model; leave {other} out.")
        if self.order != "parts-first":
            raise InputError("An order belongs to plain arrays; leave --order out.")
        if not self.register:
            raise InputError("No photo is registered on an index; leave --no-register out.")
        folder = Path(self.query) if self.query is not None and Path(self.query).is_dir() else None
        if self.flight is not None and self.map is None:
            raise InputError("A flight is searched for on its map; give --map beside --flight.")
        if self.flight is not None and (self.data is not None or folder is not None):
            raise InputError("The frames of the flight are the queries; leave --data and a folder as --query out.")
        if self.flight is None and self.data is None and folder is None:
            raise InputError(
                "An index has tiles and no queries; give --data, a folder of pictures as --query, or --map and --flight."
            )
        return partial(
            open_indexed,
            where,
            self.model,
            self.data,
            folder,
            self.map,
            self.flight,
            None if folder is not None else self.query,
            DEPTH if self.depth is None else self.depth,
            self.provider,
            self.kind,
        )

    def _flight(self) -> Callable[[], Workspace]:
        from explorer.opening import open_flight_over

        if self.map is None or self.flight is None:
            given, missing = ("--map", "--flight") if self.flight is None else ("--flight", "--map")
            raise InputError(f"A flight is explored over its map; give {missing} beside {given}.")
        others = {"--data": self.data, "--saved": self.saved, "--n-parts": self.n_parts}
        if other := next((name for name, value in others.items() if value is not None), None):
            raise InputError(
                f"The frames of the flight are the queries, and the map is the gallery; leave {other} out."
            )
        if self.model is None:
            raise InputError("A flight is explored with a model; give a trained LPN with --model.")
        return partial(
            open_flight_over,
            self.map,
            self.flight,
            self.model,
            self.query,
            self.beside,
            self.register,
            self.provider,
            kind=self.kind,
            second_kind=self.beside_kind,
        )
