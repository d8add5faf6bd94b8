"""The command `lpn explore`, which the entry point `lpn.commands` adds to `lpn`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, cast

import tyro

from explorer.parameters import DATA
from lpn.core.demo import DEMO, DEMO_ANSWERS, DEMO_BASELINE, DEMO_FLIGHT, DEMO_MODEL, DEMO_PHOTO, DEMO_PLACE, DEMO_QUERY
from lpn.core.errors import InputError
from lpn.core.files import check_outputs, printable
from lpn.core.resources import ProviderName
from lpn.core.texts import counted
from lpn.descriptors.weather import WeatherName
from lpn.flight.commands.live import LiveInput, MapError
from lpn.flight.locate.source import FlightSource
from lpn.models.adapters import Kind
from lpn.sources import Advanced, ModelOptions, SourceOptions, of_each, shipped_model, source_of
from lpn.sources.kinds.data import DataSource

if TYPE_CHECKING:
    from explorer.server.auth import Authenticator
    from explorer.workspace import Workspace, Workspaces
    from lpn.core.served_page import ServedPage
    from lpn.models.base import Model
    from lpn.tasks.task import Task


@dataclass(kw_only=True)
class ServeOptions:
    """The server."""

    host: str = "127.0.0.1"
    """Address to listen on; on any other than 127.0.0.1, other machines can connect with the token in the printed link."""
    port: int = 8080
    """Port to listen on."""
    token: Advanced[str | None] = None
    """Token to ask for, at least 12 characters; other users see it in the list of processes, so better set LPN_TOKEN."""
    ask_token: Advanced[bool] = False
    """Ask for a token on 127.0.0.1 too; otherwise other users of this machine can connect without one."""
    allow_host: Advanced[Annotated[tuple[str, ...], tyro.conf.UseAppendAction]] = ()
    """A further host name of the page, such as that of a reverse proxy (docs/serving.md); once for each."""

    def authenticator(self) -> Authenticator:
        """Return the access rules; InputError if the token is too short, or a host name is malformed."""
        from explorer.server.auth import make_authenticator

        return make_authenticator(self.host or "0.0.0.0", self.token, self.ask_token, self.allow_host)


@dataclass(kw_only=True)
class ModelsBeside:
    """Models to compare with."""

    beside: tuple[Path, ...] = ()
    """Other trained models to choose in the page's head, such as those with other parts or input sizes."""
    beside_kind: Advanced[Annotated[tuple[Kind | Literal["auto"], ...], tyro.conf.arg(metavar="KIND")]] = ()
    """Methods of the models of --beside, in the same order; auto for a model that names its method. See --kind."""
    beside_pooling: Advanced[tuple[str, ...]] = ()
    """Poolings of the models of --beside, in the same order; auto for a model with parts. See --pooling."""

    def models_beside(self, provider: ProviderName) -> list[ModelOptions]:
        """Return these models; InputError if some but not all of them have a kind, or a pooling."""
        given = {"--beside-kind": self.beside_kind, "--beside-pooling": self.beside_pooling}
        for option, values in given.items():
            if values and not self.beside:
                raise InputError(f"{option} needs --beside.")
        options = (of_each(option, values, len(self.beside), "models of --beside") for option, values in given.items())
        return [
            ModelOptions(model=file, kind=cast("Kind | None", kind), pooling=pooling, provider=provider)
            for file, kind, pooling in zip(self.beside, *options, strict=True)
        ]


@dataclass(kw_only=True)
class ExploreLive(ServeOptions, LiveInput):
    """Show a flight in progress in a browser, located as by lpn locate --live."""

    SERVES: ClassVar[bool] = True

    def run(self) -> None:
        from explorer.flight.live import LiveApp, LiveRecord
        from explorer.server.page_server import warn_of_listening
        from lpn.flight.live.frames import shown_name
        from lpn.flight.maps import open_map

        authenticator = self.authenticator()
        with ExitStack() as stack:
            basemap = stack.enter_context(closing(open_map(self.map)))
            record = LiveRecord(shown_name(self.live), basemap)
            stack.callback(record.forget)
            app = LiveApp(record, self.host or "0.0.0.0", self.port, authenticator)
            stack.callback(app.close)

            def say(sentence: str) -> None:
                print(printable(sentence), file=sys.stderr, flush=True)
                record.note(sentence)

            run = self.open_run(say, [record.send], stack, [record.count_windows])
            warn_of_listening(self.host or "0.0.0.0", self.port)
            print(f"LPN Explorer is ready: {app.link}  (stop with Ctrl-C)", flush=True)
            say(f"The flight has ended with {counted(run(), 'frame')} located, and the page goes on showing them.")
            while True:
                time.sleep(0.5)


@dataclass(kw_only=True)
class Explore(ModelsBeside, ServeOptions, SourceOptions):
    """Open the explorer in a browser: on a source, by default on the demo."""

    # The command runs until it is stopped, so a stop is no failure.
    SERVES: ClassVar[bool] = True
    MODES: ClassVar[dict[str, type[ExploreLive]]] = {"--live": ExploreLive}

    query: str | None = None
    """Name of the query to open with, as the picker shows it; by default the first."""
    beside_weather: Advanced[tuple[WeatherName, ...]] = ()
    """Weathers, such as fog rain; the model under each is one more to compare with, besides those of --beside."""
    register: Advanced[bool] = True
    """Lay each photo of a flight over the map; this goes on in the background, and its answers are kept."""
    map_error: MapError = None
    stories: Advanced[Path | None] = None
    """File (.json) for the steps of stories that the key S saves; by default stories.json beside the data."""

    def run(self) -> None:
        from explorer.app import serve
        from explorer.screen.panels.stories.story import read_stories

        authenticator, opening = self.authenticator(), self.workspaces()
        check_outputs((self.stories, ".json"))
        if self.stories is not None:
            read_stories(self.stories)
        serve(opening, self.host, self.port, authenticator, self.stories)

    @staticmethod
    def in_background(
        source: Model | Task | Path | None,
        data: Path | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        calibrate: bool | None = None,
        csls: int = 0,
    ) -> ServedPage:
        """Serve until the page is closed or the process ends, see `lpn.explore`."""
        from explorer.app import serve_in_background
        from explorer.opening import open_model, open_tasks
        from explorer.workspace import Workspaces
        from lpn.models.base import Model
        from lpn.tasks.task import Task

        authenticator = ServeOptions(host=host, port=port).authenticator()
        if isinstance(source, Task):
            if data is not None or calibrate is not None or csls:
                raise InputError("A task has its own data and scoring; leave the data set, calibrate, and csls out.")
            opening = Workspaces(partial(open_tasks, [source]))
        elif isinstance(source, Model):
            query = DEMO_QUERY if data is None else None
            opening = Workspaces(partial(open_model, data or DEMO, source, query, calibrate=calibrate, csls=csls))
        else:
            folder = None if data is None else str(data)
            opening = Explore(source=folder, model=source, calibrate=calibrate, csls=csls).workspaces()
        return serve_in_background(opening, host, port, authenticator)

    def opens_data(self) -> Callable[[], Workspace]:
        """Return a function that opens the data set, by default the demo's city, under the model.

        Raises:
            InputError: if an option lacks another one that it needs, or the demo's files are missing.
        """
        from explorer.opening import open_model

        for option, given in (("--kind", self.kind), ("--pooling", self.pooling)):
            if given is not None and self.model is None:
                raise InputError(f"{option} needs --model.")
        beside = self.models_beside(self.provider)
        if self.source is None and not DEMO.is_dir():
            raise InputError(
                "The demo's files are missing from this installation; install lpn-explorer again, or give a data set, and a "
                "model with --model."
            )
        query = DEMO_QUERY if self.source is None and self.query is None else self.query
        baseline = DEMO_BASELINE if self._is_demo and DEMO_BASELINE.is_file() else None
        return partial(
            open_model,
            DEMO if self.source is None else self.path,
            replace(self, model=self.model or (DEMO_MODEL if self.source is None else shipped_model())),
            query,
            beside,
            baseline,
            self.calibrate,
            self.csls,
            self.task,
            self.beside_weather,
        )

    def workspaces(self) -> Workspaces:
        """Return the functions that open the workspaces.

        Raises:
            InputError: if an option does not fit the source, or lacks another one that it needs.
        """
        from explorer.opening import open_flight_over, open_source
        from explorer.workspace import Workspaces

        if self.source is None:
            return self._demo()
        source = source_of(self)
        if isinstance(source, DataSource):
            return Workspaces(self.opens_data())
        if isinstance(source, FlightSource) and self.index is None:
            beside = self.models_beside(self.provider)
            where = source.map_path, self.path
            opens = partial(open_flight_over, *where, self, self.query, beside, self.register, map_error=self.map_error)
            return Workspaces(opens)
        return Workspaces(partial(open_source, self, self.query))

    def _demo(self) -> Workspaces:
        from explorer.opening import OFFERED_OVERLAP, offered, open_flight_over
        from explorer.workspace import Workspaces

        of_source = [one for one in self.of_source() if one not in ("--calibrate", "--csls")]
        of_source += [] if self.map_error is None else ["--map-error"]
        of_source += [] if self.register else ["--no-register"]
        if of_source:
            raise InputError(f"{of_source[0]} needs a source; name it: lpn explore SOURCE.")
        open_data = self.opens_data()
        if not self._is_demo:
            return Workspaces(open_data)
        model, others = replace(self, model=DEMO_MODEL), {}
        for key, (map_path, flight_path), query in (("place", DEMO_PLACE, DEMO_PHOTO), ("flight", DEMO_FLIGHT, None)):
            if map_path.exists():
                shipped = map_path.with_name(DEMO_ANSWERS)
                opens = partial(
                    open_flight_over, map_path, flight_path, model, query, overlap=OFFERED_OVERLAP, shipped=shipped
                )
                others[key] = offered(_LABELS[key], [map_path, flight_path, DEMO_MODEL], opens)
        return Workspaces(open_data, others, _LABELS[DATA])

    @property
    def _is_demo(self) -> bool:
        return self.source is None and self.model is None


_LABELS = {DATA: "a computer-generated city", "place": "a real flight", "flight": "a computer-generated flight"}
