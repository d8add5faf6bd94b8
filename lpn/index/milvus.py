"""Milvus (the extra `cluster`): an index in a collection on a server or a cluster.

A collection has the fields id (primary key: a 128-bit hash of the tile's name in hexadecimal, which needs no escaping in
expressions), name, vector (n D numbers, inner product), latitude, and longitude. Its description holds the format.

A search sees the writes of this process; recent writes of others may be missing for seconds. When `add` returns, the tiles
are in the server's log and survive its death. A lost connection is retried for a while; `add` is an upsert, so a repeated
attempt loses and duplicates nothing.

`flat` compares every vector. `hnsw` is approximate, and may return too few tiles, as in a box. Milvus returns
ties in any order; they are sorted by name.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from importlib import import_module
from typing import Any, Literal, TypeVar, cast, get_args
from urllib.parse import unquote, urlsplit

import msgspec
import numpy as np
import numpy.typing as npt

from lpn.core.arrays import BoolArray, Float32Array, Float64Array
from lpn.core.errors import InputError, StoreError
from lpn.core.files import printable
from lpn.core.formats import is_newer, newer_version
from lpn.index.base import (
    ID_LENGTH,
    DegreeBox,
    DescriptorKind,
    Index,
    SearchResult,
    best,
    check_box,
    check_count,
    no_such_tile,
    scores_of,
)

FORMAT = "lpn-milvus/1"
SCHEME = "milvus"
Structure = Literal["flat", "hnsw"]

# Latitude and longitude of a tile without a position, outside of every box, as Milvus 2.3 has no null.
_NOWHERE = 1000.0
# Maximum of bytes of a message's vectors, far below a server's limit of 64 MB, and of its rows.
_BYTES, _ROWS = 8 << 20, 1000
_CALL = 30.0
# Minimum of neighbours that hnsw visits.
_EFFORT = 128
# Seconds between two attempts to reach a server.
_PAUSE = 1.0
_BUILD: dict[Structure, dict[str, Any]] = {
    "flat": {"index_type": "FLAT", "params": {}},
    "hnsw": {"index_type": "HNSW", "params": {"M": 32, "efConstruction": 200}},
}
# Milvus's codes of permanent errors: a missing collection, or an invalid parameter.
_REFUSED = {65, 100, 1100, 1101}
_FORBIDDEN = {1400, 1401, 1800}
# Names of the gRPC errors that Milvus 2.3 sends instead of these codes.
_FORBIDDEN_NAMES = {"PERMISSION_DENIED", "UNAUTHENTICATED"}
_COLLECTION = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,254}")
_FIELDS = ["name", "vector", "latitude", "longitude"]
_T = TypeVar("_T")


class MilvusIndex(Index):
    """A collection on a Milvus server, 2.3 or later.

    Args:
        url: milvus://host:port/collection, or milvus://user:password@host:port/collection.
        patience: seconds for which an unreachable server is tried again.

    Raises:
        StoreError: when there is no such server or collection, or lpn did not make it.
        InputError: when the address is malformed.
        ModuleNotFoundError: when pymilvus is not installed.
    """

    engine = "milvus"
    most = 16384
    _client: Any = None

    def __init__(self, url: str, patience: float = 60.0) -> None:
        self._open(url, patience)
        try:
            description = self._call(self._description)
            if description is None:
                raise StoreError(f"{self._url} has no such collection; make it with lpn index.")
            self.kind, self.structure = _read(description, self._url)
            self._call(lambda client: client.load_collection(self._name))
        except BaseException:
            self.close()
            raise

    @classmethod
    def create(
        cls, url: str, kind: DescriptorKind, structure: Structure = "flat", patience: float = 60.0
    ) -> MilvusIndex:
        """Make an empty collection, or open an existing one of the same kind.

        Raises:
            StoreError: when there is no server, or the collection holds something else.
        """
        if structure not in get_args(Structure):
            raise InputError(f"The structure is {structure!r}; expected one of {', '.join(get_args(Structure))}.")
        made = cls.__new__(cls)
        made._open(url, patience)
        try:
            made._call(partial(made._make, kind, structure))
        finally:
            made.close()
        index = cls(url, patience)
        if (index.kind, index.structure) != (kind, structure):
            one = f"{_describe(index.kind)} ({index.structure})"
            index.close()
            raise StoreError(
                f"{index._url} holds {one}, and this would be {_describe(kind)} ({structure}); choose another collection."
            )
        return index

    def _add(self, names: list[str], vectors: Float32Array, places: Float64Array) -> None:
        """Add tiles. Each message is atomic, so an error may leave some of the tiles added."""
        degrees = np.where(np.isnan(places), _NOWHERE, places).tolist()
        for start in range(0, len(names), self._step):
            rows = [
                {"id": key_of(name), "name": name, "vector": vector.tolist(), "latitude": at[0], "longitude": at[1]}
                for name, vector, at in list(zip(names, vectors, degrees, strict=True))[start : start + self._step]
            ]
            self._call(lambda client, rows=rows: client.upsert(self._name, rows, timeout=_CALL))  # type: ignore[misc]

    def search(
        self, query: npt.ArrayLike, weights: npt.ArrayLike | None, k: int, box: DegreeBox | None = None
    ) -> SearchResult:
        """See `Index.search`; at most 16,384 tiles; ties are sorted by name."""
        wanted = self.kind.rescaled(query, weights)
        k, box = check_count(k), check_box(box)
        if k > self.most:
            raise InputError(f"The number of tiles asked for is {k}; Milvus gives {self.most} at most.")
        effort = {} if self.structure == "flat" else {"ef": max(_EFFORT, k)}

        def searched(client: Any) -> list[str]:
            hits = client.search(
                self._name,
                data=[wanted.astype(np.float32).tolist()],
                filter="" if box is None else expression(box),
                limit=k,
                output_fields=["id"],
                search_params={"metric_type": "IP", "params": effort},
                anns_field="vector",
                **_level("Session"),
            )
            return [str(hit["id"]) for hit in hits[0]]

        rows = sorted(self._rows(self._call(searched), level="Session").values(), key=lambda row: str(row["name"]))
        vectors, places = self._arrays(rows)
        scores = scores_of(vectors.reshape(-1, self.kind.numbers), wanted)
        chosen = best(scores, np.arange(len(rows)), k)
        return SearchResult([str(rows[i]["name"]) for i in chosen], scores[chosen], vectors[chosen], places[chosen])

    def read(self, ids: Sequence[str]) -> tuple[Float32Array, Float64Array]:
        """See `Index.read`."""
        keys = [key_of(name) for name in ids]
        rows = self._rows(keys)
        if missing := [name for name, key in zip(ids, keys, strict=True) if key not in rows]:
            raise no_such_tile(missing[0])
        return self._arrays([rows[key] for key in keys])

    def holds(self, ids: Sequence[str]) -> BoolArray:
        """See `Index.holds`."""
        keys = [key_of(name) for name in ids]
        there = self._rows(keys, ["id"])
        return np.array([key in there for key in keys], np.bool_)

    def count(self) -> int:
        """See `Index.count`."""
        rows = self._call(
            lambda client: client.query(self._name, filter="", output_fields=["count(*)"], **_level("Strong"))
        )
        return int(rows[0]["count(*)"])

    def close(self) -> None:
        """See `Index.close`."""
        client, self._client = self._client, None
        if client is not None:
            with suppress(Exception):  # the connection may be lost already
                client.close()

    def _open(self, url: str, patience: float) -> None:
        self._milvus = cast(Any, import_module("pymilvus"))
        # pymilvus logs a traceback of each attempt; we report a permanent error once.
        logging.getLogger("pymilvus").setLevel(logging.CRITICAL + 1)
        self._address, self._token, self._name = parse_url(url)
        self._url = f"{SCHEME}://{self._address}/{self._name}"
        self._patience = patience

    @property
    def _step(self) -> int:
        """Number of tiles in one message."""
        return max(1, min(_ROWS, _BYTES // (4 * self.kind.numbers)))

    def _description(self, client: Any) -> str | None:
        if not client.has_collection(self._name, timeout=_CALL):
            return None
        return str(client.describe_collection(self._name, timeout=_CALL).get("description", ""))

    def _make(self, kind: DescriptorKind, structure: Structure, client: Any) -> None:
        """Create the collection with its identifying description, and then its index if it is missing."""
        types = self._milvus.DataType
        if not client.has_collection(self._name, timeout=_CALL):
            description = json.dumps({"format": FORMAT, **asdict(kind), "structure": structure})
            schema = client.create_schema(auto_id=False, enable_dynamic_field=False, description=description)
            schema.add_field("id", types.VARCHAR, is_primary=True, max_length=32)
            schema.add_field("name", types.VARCHAR, max_length=4 * ID_LENGTH)
            schema.add_field("vector", types.FLOAT_VECTOR, dim=kind.numbers)
            schema.add_field("latitude", types.DOUBLE)
            schema.add_field("longitude", types.DOUBLE)
            client.create_collection(self._name, schema=schema, consistency_level="Strong", timeout=_CALL)
        _read(str(self._description(client)), self._url)
        if not client.list_indexes(self._name):
            parameters = client.prepare_index_params()
            parameters.add_index("vector", metric_type="IP", **_BUILD[structure])
            client.create_index(self._name, parameters, timeout=_CALL)

    def _rows(
        self, keys: Sequence[str], fields: Sequence[str] = _FIELDS, level: str = "Strong"
    ) -> dict[str, dict[str, Any]]:
        """Read fields of existing tiles by their keys, in messages of bounded size."""
        rows: dict[str, dict[str, Any]] = {}
        for start in range(0, len(keys), self._step):
            asked = {"ids": list(keys[start : start + self._step]), "output_fields": ["id", *fields], **_level(level)}
            found = self._call(lambda client, asked=asked: client.query(self._name, **asked))  # type: ignore[misc]
            rows |= {str(row["id"]): dict(row) for row in found}
        return rows

    def _arrays(self, rows: Sequence[dict[str, Any]]) -> tuple[Float32Array, Float64Array]:
        """Return descriptors (B, n, D) and positions (B, 2) of rows."""
        vectors = np.array([row["vector"] for row in rows], np.float32)
        places = np.array([(row["latitude"], row["longitude"]) for row in rows], np.float64).reshape(-1, 2)
        places[places == _NOWHERE] = np.nan
        return vectors.reshape(len(rows), self.kind.n_parts, self.kind.embedding), places

    def _call(self, task: Callable[[Any], _T]) -> _T:
        """Run a task with a connected client; retry for a while if the server does not answer."""
        until, again = time.monotonic() + self._patience, False
        while True:
            try:
                if self._client is None:
                    uri = f"http://{self._address}"
                    self._client = self._milvus.MilvusClient(uri=uri, token=self._token, timeout=_CALL)
                if again and hasattr(self, "kind"):
                    self._client.load_collection(self._name)  # a restarted server has loaded no collection
                return task(self._client)
            except (StoreError, InputError):
                raise
            except Exception as error:  # pymilvus raises its own errors and those of grpc
                if (message := _denied(error)) is not None:
                    raise StoreError(
                        f"{self._url} denies access ({message}); give a user with the right to do this "
                        f"({SCHEME}://user:password@host:port/collection)."
                    ) from error
                if _is_permanent(error):
                    raise StoreError(f"{self._url} refuses: {_short(error)}.") from error
                self.close()
                if time.monotonic() + _PAUSE > until:
                    raise StoreError(
                        f"{self._url} does not answer after {self._patience:g} s ({_short(error)}); start the server, "
                        "or check the address."
                    ) from error
            again = True
            time.sleep(_PAUSE)


def parse_url(url: str) -> tuple[str, str, str]:
    """Split milvus://... into host:port, the token user:password or "", and the collection's name; InputError if malformed."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        parts, port = urlsplit(""), None
    name = parts.path.strip("/")
    if parts.scheme != SCHEME or not parts.hostname or not port or not _COLLECTION.fullmatch(name):
        raise InputError(
            f"{url.rpartition('@')[2]} is not the address of a Milvus collection; expected milvus://host:port/collection, "
            "its name of letters, digits, and underscores."
        )
    host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
    token = f"{unquote(parts.username)}:{unquote(parts.password or '')}" if parts.username else ""
    return f"{host}:{port}", token, name


def key_of(name: str) -> str:
    """Return the primary key of a tile's name."""
    return hashlib.blake2b(name.encode(), digest_size=16).hexdigest()


def expression(box: DegreeBox) -> str:
    """Format a box as a filter expression."""
    south, west, north, east = box
    both = "and" if west <= east else "or"
    # Across the antimeridian, the "or" would include tiles without a position.
    return (
        f"latitude >= {south!r} and latitude <= {north!r} and longitude <= 180.0 and "
        f"(longitude >= {west!r} {both} longitude <= {east!r})"
    )


def _read(description: str, address: str) -> tuple[DescriptorKind, Structure]:
    try:
        values: Any = json.loads(description)
        if is_newer(values["format"], FORMAT):
            raise StoreError(newer_version(address, values["format"], FORMAT))
        if values["format"] != FORMAT or values["structure"] not in get_args(Structure):
            raise ValueError("another format")
        known = {name: values.get(name) for name in ("fingerprint", "n_parts", "embedding", "windows")}
        return msgspec.convert(known, DescriptorKind), values["structure"]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise StoreError(
            f"{address} is a collection that lpn index did not make ({FORMAT}); choose another name."
        ) from error


def _describe(kind: DescriptorKind) -> str:
    windows = "" if kind.windows is None else f" of windows of {kind.windows}"
    return f"{kind.n_parts} x {kind.embedding} numbers of model {kind.fingerprint}{windows}"


def _level(consistency: str) -> dict[str, Any]:
    """Return the options of a call that sees all earlier writes ("Strong"), or those of this process ("Session")."""
    return {"consistency_level": consistency, "timeout": _CALL}


def _is_permanent(error: Exception) -> bool:
    errors = import_module("pymilvus.exceptions")
    ours = (TypeError, KeyError, AttributeError, errors.ParamError, errors.DataNotMatchException)
    return (
        isinstance(error, ours) or getattr(error, "is_input_error", False) or getattr(error, "code", None) in _REFUSED
    )


def _denied(error: Exception) -> str | None:
    """Return the server's message if it denies access or a right; None for any other error.

    pymilvus reports a wrong password as an unreachable server, with the server's message among the causes.
    """
    seen: list[BaseException] = []
    cause: BaseException | None = error
    while cause is not None and cause not in seen:
        code = getattr(cause, "code", None)
        if code in _FORBIDDEN:
            return _short(cause)
        if callable(code) and getattr(code(), "name", "") in _FORBIDDEN_NAMES:
            return _short(cause)
        seen.append(cause)
        cause = cause.__cause__ or cause.__context__
    return None


def _short(error: BaseException) -> str:
    details = getattr(error, "details", None)  # the text of gRPC's errors has many lines
    message = details() if callable(details) else getattr(error, "message", "")
    text = str(message or error or type(error).__name__)
    return printable(" ".join(text.split())[:160]).rstrip(".")
