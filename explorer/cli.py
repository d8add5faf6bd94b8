"""The command that opens the app: explore. The entry point group `lpn.commands` makes it a command of `lpn`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from lpn.core.demo import DEMO, DEMO_QUERY
from lpn.core.errors import InputError


@dataclass
class Explore:
    """Open the explorer in a browser."""

    SERVES: ClassVar[bool] = True
    """The command runs until it is stopped, so that a stop is no failure."""
    data: Path | None = None
    """Data set in any layout of docs/data.md, of which the test split is shown; by default the demo."""
    model: Path | None = None
    """Trained LPN: .onnx (needs no torch), .safetensors, or a published .pth; by default the demo's, for the demo."""
    beside: Path | None = None
    """Another trained LPN, to compare with on every query (Y, then Two models): of other parts, or before more training."""
    saved: Path | None = None
    """Result of the published test code, pytorch_result.mat, to explore in place of a model's; needs --data."""
    n_parts: int | None = None
    """Parts that the descriptors in --saved consist of; 1 by default."""
    query: str | None = None
    """Name of the query to open with, as the picker shows it; by default the first."""
    host: str = "127.0.0.1"
    """Address to listen on; any other than 127.0.0.1 lets other machines in, who need the token in the link that is printed."""
    port: int = 8080
    """Port to listen on."""
    token: str | None = None
    """Token to ask for, of 12 characters or more; others see it in the list of processes, so better set LPN_TOKEN to it."""
    ask_token: bool = False
    """Ask for a token on 127.0.0.1 too, where other users of this machine could come in otherwise."""
    allow_host: tuple[str, ...] = ()
    """Further names the page is opened by, such as that of a reverse proxy (docs/serving.md)."""

    def run(self) -> None:
        from explorer.app import run, run_saved
        from explorer.server.auth import make_authenticator
        from lpn.retrieval.published_results import check_n_parts

        authenticator = make_authenticator(self.host or "0.0.0.0", self.token, self.ask_token, self.allow_host)
        if self.saved is not None:
            if self.data is None or self.model is not None or self.beside is not None:
                raise InputError(
                    "A saved result is explored with its data set and without a model; give --saved and --data."
                )
            run_saved(
                self.data, self.saved, check_n_parts(self.n_parts), self.query, self.host, self.port, authenticator
            )
            return
        if self.n_parts is not None:
            raise InputError("A model knows its number of parts; give --n-parts with --saved only.")
        if self.data is not None and self.model is None:
            raise InputError(f"There is no model for {self.data}; give a trained LPN with --model.")
        if self.data is None and not DEMO.is_dir():
            raise InputError(
                "The demo is not part of this installation; give a data set with --data and a model with --model."
            )
        query = DEMO_QUERY if self.data is None and self.query is None else self.query
        run(self.data or DEMO, self.model or DEMO / "lpn.onnx", query, self.host, self.port, self.beside, authenticator)
