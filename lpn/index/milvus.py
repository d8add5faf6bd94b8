"""Milvus (the extra `cluster`): an index in a collection on a server or a cluster.

A collection has the fields id (primary key: a 128-bit hash of the tile's name in hexadecimal, which needs no escaping in
expressions), name, vector (n D numbers, inner product), latitude, and longitude. Its description holds the format.

Every call sees the writes of this index, and those of others before it was opened. Searches may miss what others wrote in the
last five seconds ("bounded" consistency); "strong" consistency takes Milvus 0.4 to 0.8 s a search. When `add` returns, the
tiles are in the server's log and survive its death. A lost connection is retried for a while; `add` is an upsert, so a
repeated attempt loses and duplicates nothing.

Every structure returns as many tiles as requested, if there are as many. Milvus itself returns fewer if the visited lists hold
too few, for large k or in a box; then all lists are visited. In growing segments Milvus visits lists of its own choice (16 of
128); if that leaves a result short, tiles are read and scored here.

Milvus returns ties in any order; they are sorted by name.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from importlib import import_module
from itertools import chain, repeat
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
Structure = Literal["flat", "ivf", "hnsw"]

# Latitude and longitude of a tile without a position, outside of every box, as Milvus 2.3 has no null.
_NOWHERE = 1000.0
_NAME_BYTES = 4 * ID_LENGTH
# Maximum size of a message's vectors, far below a server's limit of 64 MB (`proxy.grpc.serverMaxSendSize`).
_BYTES = 8 << 20
_ROWS = 1000
_CALL = 30.0
# Seconds after which a bounded search certainly sees a write; Milvus's own bound is five.
_RECENT = 10.0
# Maximum number of lists of a segment; smaller segments have one for 39 tiles.
_LISTS = 1024
# If at most this many tiles are in a box, all are compared, whatever the effort; one segment holds about as many.
_FEW = 50_000
_EFFORT, _MOST_EFFORT = 128, 32768
_PAUSES = (0.2, 0.5, 1.0, 2.0)
_BUILD: dict[Structure, dict[str, Any]] = {
    "flat": {"index_type": "FLAT", "params": {}},
    "ivf": {"index_type": "IVF_FLAT", "params": {"nlist": _LISTS}},
    "hnsw": {"index_type": "HNSW", "params": {"M": 32, "efConstruction": 200}},
}
# Milvus's codes of permanent errors: a missing collection, or an invalid parameter.
_REFUSED = {65, 100, 1100, 1101}
# Codes of a collection that is not loaded.
_RELEASED = {101, 103}
_FORBIDDEN = {1400, 1401, 1800}
# The names of the gRPC errors that 2.3 sends in place of these codes.
_FORBIDDEN_NAMES = {"PERMISSION_DENIED", "UNAUTHENTICATED"}
_COLLECTION = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,254}")
_FIELDS = ("name", "vector", "latitude", "longitude")
_Level = Literal["Strong", "Bounded"]
_T = TypeVar("_T")


class MilvusIndex(Index):
    """A collection on a Milvus server, 2.3 or later.

    Args:
        url: milvus://host:port/collection, or milvus://user:password@host:port/collection.
        patience: seconds for which an unreachable server is retried.
        effort: lists of each segment's 1,024 (ivf) or neighbours (hnsw) to visit, 1 to 32,768; more miss fewer tiles and take
            longer. With a box, ivf visits enough lists to compare as many tiles as without one, or all in the box, if these
            are 50,000 or fewer. The effort applies once Milvus has built its index.

    Raises:
        StoreError: when there is no such server or collection, or lpn did not make it.
        InputError: when the address is malformed, or the effort is out of range.
        ModuleNotFoundError: when pymilvus is not installed.
    """

    engine = "milvus"
    most = 16384

    def __init__(self, url: str, patience: float = 60.0, effort: int = _EFFORT) -> None:
        self._open(url, patience, effort)
        try:
            description = self._description()
            if description is None:
                raise StoreError(f"{self._url} has no such collection; make it with lpn index.")
            self.kind, self.structure = _read(description, self._url)
            self._call(self._load)
        except BaseException:
            self.close()
            raise

    @classmethod
    def create(
        cls, url: str, kind: DescriptorKind, structure: Structure = "flat", patience: float = 60.0
    ) -> MilvusIndex:
        """Make an empty collection, or open an existing one of the same kind.

        Args:
            structure: flat compares every vector; ivf and hnsw are faster for many tiles, but approximate.

        Raises:
            StoreError: when there is no server, or the collection holds something else.
        """
        if structure not in get_args(Structure):
            raise InputError(f"The structure is {structure!r}; expected one of {', '.join(get_args(Structure))}.")
        made = cls.__new__(cls)
        made._open(url, patience)
        try:
            made._make(kind, structure)
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
        """Add tiles; each message is atomic, so some of the tiles may be there after an error."""
        places = np.where(np.isnan(places), _NOWHERE, places)
        step = self._step
        for start in range(0, len(names), step):
            rows = [
                {
                    "id": key_of(names[i]),
                    "name": names[i],
                    "vector": vectors[i].tolist(),
                    "latitude": float(places[i, 0]),
                    "longitude": float(places[i, 1]),
                }
                for i in range(start, min(start + step, len(names)))
            ]
            self._call(partial(self._upsert, rows))

    def search(
        self, query: npt.ArrayLike, weights: npt.ArrayLike | None, k: int, box: DegreeBox | None = None
    ) -> SearchResult:
        """See `Index.search`; at most 16,384 tiles; ties are sorted by name."""
        wanted = self.kind.rescaled(query, weights)
        k, box = check_count(k), check_box(box)
        if k > self.most:
            raise InputError(f"The number of tiles asked for is {k}; Milvus gives {self.most} at most.")
        hits = self._call(partial(self._candidates, wanted, k, box))
        vectors = np.array([hit["vector"] for hit in hits], np.float32).reshape(len(hits), self.kind.numbers)
        names = [str(hit["name"]) for hit in hits]
        scores = scores_of(vectors, wanted)
        by_name = np.empty(len(hits), np.int64)
        by_name[sorted(range(len(hits)), key=names.__getitem__)] = np.arange(len(hits))
        chosen = best(scores, by_name, k)
        places = np.array([[hit["latitude"], hit["longitude"]] for hit in hits], np.float64).reshape(-1, 2)
        places[places == _NOWHERE] = np.nan
        shaped = vectors[chosen].reshape(len(chosen), self.kind.n_parts, self.kind.embedding)
        return SearchResult([names[i] for i in chosen], scores[chosen], shaped, places[chosen])

    def read(self, ids: Sequence[str]) -> tuple[Float32Array, Float64Array]:
        """See `Index.read`."""
        keys = [key_of(name) for name in ids]
        rows: dict[str, dict[str, Any]] = {}
        for some in _chunks(keys, self._step):
            read_rows = self._call(partial(self._read, keys=some, level="Strong"))
            rows |= {key_of(str(row["name"])): row for row in read_rows}
        if missing := [name for name, key in zip(ids, keys, strict=True) if key not in rows]:
            raise no_such_tile(missing[0])
        vectors = np.array([rows[key]["vector"] for key in keys], np.float32)
        places = np.array([[rows[key]["latitude"], rows[key]["longitude"]] for key in keys], np.float64).reshape(-1, 2)
        places[places == _NOWHERE] = np.nan
        return vectors.reshape(len(ids), self.kind.n_parts, self.kind.embedding), places

    def holds(self, ids: Sequence[str]) -> BoolArray:
        """See `Index.holds`."""
        there: set[str] = set()
        keys = [key_of(name) for name in ids]
        for some in _chunks(keys, _ROWS):
            rows = self._call(partial(self._there, some))
            there.update(str(row["id"]) for row in rows)
        return np.array([key in there for key in keys], np.bool_)

    def count(self) -> int:
        """See `Index.count`."""
        return self._call(lambda client: self._counted(client, "", "Strong"))

    def close(self) -> None:
        """See `Index.close`."""
        self._disconnect()

    def _open(self, url: str, patience: float, effort: int = _EFFORT) -> None:
        if int(effort) != effort or not 1 <= effort <= _MOST_EFFORT:
            raise InputError(
                f"The effort is {effort}; expected 1 to {_MOST_EFFORT} lists or neighbours to look through."
            )
        self._milvus = cast(Any, import_module("pymilvus"))
        # pymilvus logs a traceback of each attempt; we report a permanent error once.
        logging.getLogger("pymilvus").setLevel(logging.CRITICAL + 1)
        self._address, self._token, self._name = parse_url(url)
        self._url = f"{SCHEME}://{self._address}/{self._name}"
        self._patience, self._effort = patience, effort
        self._client: Any = None
        self._written = 0.0

    @property
    def _step(self) -> int:
        """Number of tiles in one message."""
        return max(1, min(_ROWS, _BYTES // (4 * self.kind.numbers)))

    def _description(self) -> str | None:
        def described(client: Any) -> str | None:
            if not client.has_collection(self._name, timeout=_CALL):
                return None
            return str(client.describe_collection(self._name, timeout=_CALL).get("description", ""))

        return self._call(described)

    def _make(self, kind: DescriptorKind, structure: Structure) -> None:
        """Create the collection, with the description that identifies it, and then its index if it is missing."""

        def make(client: Any) -> None:
            types = self._milvus.DataType
            if not client.has_collection(self._name, timeout=_CALL):
                description = json.dumps({"format": FORMAT, **asdict(kind), "structure": structure})
                schema = client.create_schema(auto_id=False, enable_dynamic_field=False, description=description)
                schema.add_field("id", types.VARCHAR, is_primary=True, max_length=32)
                schema.add_field("name", types.VARCHAR, max_length=_NAME_BYTES)
                schema.add_field("vector", types.FLOAT_VECTOR, dim=kind.numbers)
                schema.add_field("latitude", types.DOUBLE)
                schema.add_field("longitude", types.DOUBLE)
                client.create_collection(self._name, schema=schema, consistency_level="Strong", timeout=_CALL)
            _read(str(client.describe_collection(self._name, timeout=_CALL).get("description", "")), self._url)
            if not client.list_indexes(self._name):
                parameters = client.prepare_index_params()
                parameters.add_index("vector", metric_type="IP", **_BUILD[structure])
                client.create_index(self._name, parameters, timeout=_CALL)

        self._call(make)

    def _load(self, client: Any) -> None:
        client.load_collection(self._name)
        self._written = time.monotonic()  # others may have written while the collection was loading

    def _upsert(self, rows: list[dict[str, Any]], client: Any) -> None:
        client.upsert(self._name, rows, timeout=_CALL)
        self._written = time.monotonic()

    def _there(self, keys: list[str], client: Any) -> list[dict[str, Any]]:
        return cast("list[dict[str, Any]]", client.query(self._name, ids=keys, output_fields=["id"], **_now()))

    def _counted(self, client: Any, within: str, level: _Level) -> int:
        rows = client.query(self._name, filter=within, output_fields=["count(*)"], **_now(level))
        return int(rows[0]["count(*)"])

    def _candidates(self, wanted: Float64Array, k: int, box: DegreeBox | None, client: Any) -> list[dict[str, Any]]:
        """Return the fields of k tiles or more, fewer only if there are fewer."""
        level: _Level = "Strong" if time.monotonic() - self._written < _RECENT else "Bounded"
        within = "" if box is None else expression(box)
        lists = self._lists(client, within)
        hits = self._searched(client, wanted, k, within, lists, level)
        if len(hits) < k and lists < _LISTS and self.structure == "ivf":
            hits = self._searched(client, wanted, k, within, _LISTS, level)
        if len(hits) < k and self.structure != "flat" and len(hits) < self._counted(client, within, level):
            return self._all(client, wanted, k, within, level)
        return hits

    def _lists(self, client: Any, within: str) -> int:
        """Return the number of lists to visit in each segment; its counts may be seconds old."""
        lists = min(self._effort, _LISTS)
        if not within or self.structure != "ivf":
            return lists
        inside = self._counted(client, within, "Bounded")
        if inside <= _FEW:
            return _LISTS
        return min(_LISTS, -(-lists * self._counted(client, "", "Bounded") // inside))

    def _searched(
        self, client: Any, wanted: Float64Array, k: int, within: str, lists: int, level: _Level
    ) -> list[dict[str, Any]]:
        effort = {"flat": {}, "ivf": {"nprobe": lists}, "hnsw": {"ef": max(self._effort, k)}}[self.structure]
        whole = k <= self._step
        hits = client.search(
            self._name,
            data=[wanted.astype(np.float32).tolist()],
            filter=within,
            limit=k,
            output_fields=list(_FIELDS) if whole else [],
            search_params={"metric_type": "IP", "params": effort},
            anns_field="vector",
            **_now(level),
        )
        if whole:
            return [dict(hit["entity"]) for hit in hits[0]]
        keys = [str(hit["id"]) for hit in hits[0]]
        return [row for some in _chunks(keys, self._step) for row in self._read(client, some, level)]

    def _read(self, client: Any, keys: list[str], level: _Level) -> list[dict[str, Any]]:
        rows = client.query(self._name, ids=keys, output_fields=list(_FIELDS), **_now(level))
        return [dict(row) for row in rows]

    def _all(self, client: Any, wanted: Float64Array, k: int, within: str, level: _Level) -> list[dict[str, Any]]:
        """Read all tiles within the filter and return the k best, for when the index returns fewer than k."""
        keys: list[str] = []
        while True:  # page by key, because offsets are limited to 16,384
            after = f'id > "{keys[-1] if keys else ""}"'
            page = client.query(
                self._name,
                filter=f"({within}) and {after}" if within else after,
                limit=self.most,
                output_fields=["id"],
                **_now(level),
            )
            if not page:  # a short page may only have had a duplicate key
                break
            keys += sorted({str(row["id"]) for row in page})
        nearest: list[dict[str, Any]] = []
        for some in _chunks(keys, self._step):
            nearest += self._read(client, some, level)
            scores = scores_of(np.array([row["vector"] for row in nearest], np.float32), wanted)
            by_name = np.argsort(np.argsort([row["name"] for row in nearest]))
            nearest = [nearest[i] for i in best(scores, by_name, k)]
        return nearest

    def _call(self, task: Callable[[Any], _T]) -> _T:
        """Run a task with a connected client, retrying for a while if the server does not answer."""
        until = time.monotonic() + self._patience
        released = False
        for pause in chain(_PAUSES, repeat(_PAUSES[-1])):
            try:
                if self._client is None:
                    self._written = time.monotonic()  # others may have written
                    self._client = self._milvus.MilvusClient(
                        uri=f"http://{self._address}", token=self._token, timeout=_CALL
                    )
                if released:
                    self._load(self._client)
                return task(self._client)
            except (StoreError, InputError):
                raise
            except Exception as error:  # pymilvus raises its own errors and those of grpc
                if (message := _denied(error)) is not None:
                    raise StoreError(
                        f"{self._url} denies access ({message}); give a user with the right to do this "
                        f"({SCHEME}://user:password@host:port/collection)."
                    ) from error
                if not self._is_temporary(error):
                    raise StoreError(f"{self._url} refuses: {_short(error)}.") from error
                released = getattr(error, "code", None) in _RELEASED
                if not released:
                    self._disconnect()
                if time.monotonic() + pause > until:
                    raise StoreError(
                        f"{self._url} does not answer after {self._patience:g} s ({_short(error)}); start the server, "
                        "or check the address."
                    ) from error
                time.sleep(pause)
        raise AssertionError

    def _is_temporary(self, error: Exception) -> bool:
        """Return whether an error may be temporary, as while a server starts."""
        errors = import_module("pymilvus.exceptions")
        refused = isinstance(error, (errors.ParamError, errors.DataNotMatchException)) or getattr(
            error, "is_input_error", False
        )
        mine = isinstance(error, (TypeError, KeyError, AttributeError))
        return not refused and not mine and getattr(error, "code", None) not in _REFUSED

    def _disconnect(self) -> None:
        if self._client is not None:
            with suppress(Exception):  # the connection may be lost already
                self._client.close()
            self._client = None


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


def _now(consistency: _Level = "Strong") -> dict[str, Any]:
    """Return the options of a call; "Strong" sees all earlier writes, "Bounded" may miss those of the last seconds."""
    return {"consistency_level": consistency, "timeout": _CALL}


def _chunks(keys: list[str], size: int) -> Iterator[list[str]]:
    return (keys[start : start + size] for start in range(0, len(keys), size))


def _denied(error: Exception) -> str | None:
    """Return the server's message if it denies the user access or a right; None for any other error.

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
