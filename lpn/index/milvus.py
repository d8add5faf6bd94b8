"""Milvus (the extra `milvus`): one collection on a server or a cluster, through the same protocol.

A collection has the fields id (128 bits of the digest of the tile's name, in hexadecimal digits: its primary key, of which no
sign can be mistaken in an expression), name, vector (n D numbers, inner product), latitude, and longitude, and says in its
description what it holds. Every call sees what this index wrote, and whatever was written before the index was opened; searches
may miss what others wrote in the last five seconds ("bounded" consistency), as waiting for that ("strong") takes Milvus 0.4 to
0.8 s a search. What `add` returned from is in the server's log: a server that is killed has it again when it is back. A lost
connection is tried anew for a while; `add` writes over what an interrupted attempt left, so that nothing is lost and nothing
is twice.

Every structure gives as many tiles as were asked for, or all that there are. Milvus itself gives fewer where the lists that
it looks through hold too few, as they may for many tiles or in a box: all lists are looked through then. Of a segment that
still grows Milvus looks through lists of its own choice (16 of 128); where that leaves an answer short, tiles are read and
scored here.

Milvus keeps no order among equal scores; those that come back are ordered by name.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from importlib import import_module
from itertools import chain, repeat
from typing import Any, Literal, TypeVar, cast, get_args
from urllib.parse import unquote, urlsplit

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import BoolArray, Float64Array
from lpn.core.errors import InputError, StoreError
from lpn.core.files import printable
from lpn.core.formats import is_newer, newer_version
from lpn.index.base import (
    ID_LENGTH,
    Box,
    Index,
    Kind,
    SearchResult,
    best,
    check_box,
    check_count,
    check_names,
    check_positions,
    scores_of,
)

FORMAT = "lpn-milvus/1"
SCHEME = "milvus"
Structure = Literal["flat", "ivf", "hnsw"]

_NOWHERE = 1000.0
"""Latitude and longitude of a tile that has none: 2.3 knows no null, and no box reaches so far."""
_NAME_BYTES = 4 * ID_LENGTH
_BYTES = 8 << 20
"""Of one message's vectors, far below the 64 MB that a server takes or gives (`proxy.grpc.serverMaxSendSize`)."""
_ROWS = 1000
_CALL = 30.0
_RECENT = 10.0
"""Seconds after which a bounded search sees a write for certain; Milvus's own bound is five."""
_LISTS = 1024
"""Of each segment that has an index, at most: smaller ones have one for 39 tiles."""
_FEW = 50_000
"""Tiles in a box up to which all of them are compared, whatever the effort: as many as one segment holds."""
_MOST_EFFORT = 32768
_PAUSES = (0.2, 0.5, 1.0, 2.0)
_BUILD: dict[Structure, dict[str, Any]] = {
    "flat": {"index_type": "FLAT", "params": {}},
    "ivf": {"index_type": "IVF_FLAT", "params": {"nlist": _LISTS}},
    "hnsw": {"index_type": "HNSW", "params": {"M": 32, "efConstruction": 200}},
}
_REFUSED = {65, 100, 1100, 1101}
"""Milvus's codes for what no trying again mends: a collection that is gone, or a wrong parameter."""
_RELEASED = {101, 103}
"""Of a collection that somebody has let go of, or that is being loaded."""
_FORBIDDEN = {1400, 1401, 1800}
_FORBIDDEN_NAMES = {"PERMISSION_DENIED", "UNAUTHENTICATED"}
"""What 2.3 says through gRPC in place of these codes."""
_COLLECTION = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,254}")
_FIELDS = ("name", "vector", "latitude", "longitude")
_Level = Literal["Strong", "Bounded"]
_T = TypeVar("_T")


class MilvusIndex(Index):
    """A collection on a Milvus server, 2.3 or later.

    Args:
        url: milvus://host:port/collection, or milvus://user:password@host:port/collection.
        patience: seconds for which a server that does not answer is tried again.
        effort: 1 to 32,768 lists of each segment's 1,024 (ivf) or neighbours (hnsw) looked through; more miss fewer tiles
            and take longer. With a box, ivf looks through so many lists that it compares as many tiles as without one,
            or all in the box: always all where these are 50,000 or fewer. Milvus does so once it has built its index.

    Raises:
        StoreError: when there is no such server or collection, or it is not one of ours.
        InputError: when the address is none, or the effort is not as expected.
        ModuleNotFoundError: when pymilvus is not installed.
    """

    most = 16384

    def __init__(self, url: str, patience: float = 60.0, effort: int = 128) -> None:
        self._open(url, patience, effort)
        try:
            description = self._description()
            if description is None:
                raise StoreError(f"{self._shown} has no such collection; make it with lpn index.")
            self.kind, self.structure = _read(description, self._shown)
            self._call(self._load)
        except BaseException:
            self.close()
            raise

    @classmethod
    def create(
        cls, url: str, kind: Kind, structure: Structure = "flat", patience: float = 60.0, effort: int = 128
    ) -> MilvusIndex:
        """Make an empty collection, or open the one of the same kind that is there.

        Args:
            structure: flat compares every vector and misses nothing; ivf and hnsw are quicker among many tiles.

        Raises:
            StoreError: when there is no server, or the collection holds something else.
        """
        if structure not in get_args(Structure):
            raise InputError(f"The structure is {structure!r}; expected one of {', '.join(get_args(Structure))}.")
        made = cls.__new__(cls)
        made._open(url, patience, effort)
        try:
            made._make(kind, structure)
        finally:
            made.close()
        index = cls(url, patience, effort)
        if (index.kind, index.structure) != (kind, structure):
            one = f"{_said(index.kind)} ({index.structure})"
            index.close()
            raise StoreError(
                f"{index._shown} holds {one}, and this would be {_said(kind)} ({structure}); choose another collection."
            )
        return index

    def add(
        self,
        ids: Sequence[str],
        descriptors: npt.ArrayLike,
        positions: Sequence[Sequence[float]] | Float64Array | None = None,
    ) -> None:
        """See `Index.add`; in messages that are each whole, so that after an error some of the tiles can be there."""
        vectors = self.kind.checked(descriptors)
        names = check_names(ids, len(vectors))
        places = check_positions(positions, len(vectors))
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
        self, query: npt.ArrayLike, weights: npt.ArrayLike | None, k: int, box: Box | None = None
    ) -> SearchResult:
        """See `Index.search`; at most 16,384 tiles; equal scores by name."""
        wanted = self.kind.rescaled(query, weights)
        k, box = check_count(k), check_box(box)
        if k > self.most:
            raise InputError(f"The number of tiles asked for is {k}; Milvus gives {self.most} at most.")
        hits = self._call(partial(self._found, wanted, k, box))
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

    def holds(self, ids: Sequence[str]) -> BoolArray:
        """See `Index.holds`."""
        there: set[str] = set()
        keys = [key_of(name) for name in ids]
        for some in _lots(keys, _ROWS):
            found = self._call(partial(self._there, some))
            there.update(str(row["id"]) for row in found)
        return np.array([key in there for key in keys], np.bool_)

    def count(self) -> int:
        """See `Index.count`."""
        return self._call(lambda client: self._counted(client, "", "Strong"))

    def close(self) -> None:
        """See `Index.close`."""
        self._let_go()

    def _open(self, url: str, patience: float, effort: int) -> None:
        if int(effort) != effort or not 1 <= effort <= _MOST_EFFORT:
            raise InputError(
                f"The effort is {effort}; expected 1 to {_MOST_EFFORT} lists or neighbours to look through."
            )
        self._milvus = cast(Any, import_module("pymilvus"))
        # It prints a traceback for each attempt; what cannot be mended is said once, in a sentence.
        logging.getLogger("pymilvus").setLevel(logging.CRITICAL + 1)
        self._address, self._token, self._name = parse_url(url)
        self._shown = f"{SCHEME}://{self._address}/{self._name}"
        self._patience, self._effort = patience, effort
        self._client: Any = None
        self._written = 0.0

    @property
    def _step(self) -> int:
        """Tiles of one message."""
        return max(1, min(_ROWS, _BYTES // (4 * self.kind.numbers)))

    def _description(self) -> str | None:
        def described(client: Any) -> str | None:
            if not client.has_collection(self._name, timeout=_CALL):
                return None
            return str(client.describe_collection(self._name, timeout=_CALL).get("description", ""))

        return self._call(described)

    def _make(self, kind: Kind, structure: Structure) -> None:
        """The collection, with the description that tells it from others, and then its index.

        Where an attempt ended in between, the next one makes the index.
        """

        def make(client: Any) -> None:
            types = self._milvus.DataType
            if not client.has_collection(self._name, timeout=_CALL):
                said = json.dumps({"format": FORMAT, **vars(kind), "structure": structure})
                schema = client.create_schema(auto_id=False, enable_dynamic_field=False, description=said)
                schema.add_field("id", types.VARCHAR, is_primary=True, max_length=32)
                schema.add_field("name", types.VARCHAR, max_length=_NAME_BYTES)
                schema.add_field("vector", types.FLOAT_VECTOR, dim=kind.numbers)
                schema.add_field("latitude", types.DOUBLE)
                schema.add_field("longitude", types.DOUBLE)
                client.create_collection(self._name, schema=schema, consistency_level="Strong", timeout=_CALL)
            _read(str(client.describe_collection(self._name, timeout=_CALL).get("description", "")), self._shown)
            if not client.list_indexes(self._name):
                parameters = client.prepare_index_params()
                parameters.add_index("vector", metric_type="IP", **_BUILD[structure])
                client.create_index(self._name, parameters, timeout=_CALL)

        self._call(make)

    def _load(self, client: Any) -> None:
        client.load_collection(self._name)
        self._written = time.monotonic()  # others may have, before this, which can take longer than a write is recent

    def _upsert(self, rows: list[dict[str, Any]], client: Any) -> None:
        client.upsert(self._name, rows, timeout=_CALL)
        self._written = time.monotonic()

    def _there(self, keys: list[str], client: Any) -> list[dict[str, Any]]:
        return cast("list[dict[str, Any]]", client.query(self._name, ids=keys, output_fields=["id"], **_now()))

    def _counted(self, client: Any, within: str, level: _Level) -> int:
        found = client.query(self._name, filter=within, output_fields=["count(*)"], **_now(level))
        return int(found[0]["count(*)"])

    def _found(self, wanted: Float64Array, k: int, box: Box | None, client: Any) -> list[dict[str, Any]]:
        """The fields of k tiles or more, fewer only where there are fewer."""
        level: _Level = "Strong" if time.monotonic() - self._written < _RECENT else "Bounded"
        within = "" if box is None else expression(box)
        lists = self._lists(client, within)
        found = self._searched(client, wanted, k, within, lists, level)
        if len(found) < k and lists < _LISTS and self.structure == "ivf":
            found = self._searched(client, wanted, k, within, _LISTS, level)
        if len(found) < k and self.structure != "flat" and len(found) < self._counted(client, within, level):
            return self._all(client, wanted, k, within, level)
        return found

    def _lists(self, client: Any, within: str) -> int:
        """How many lists of each segment to look through; what is counted for that may be seconds old."""
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
        found = client.search(
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
            return [dict(hit["entity"]) for hit in found[0]]
        keys = [str(hit["id"]) for hit in found[0]]
        return [row for some in _lots(keys, self._step) for row in self._read(client, some, level)]

    def _read(self, client: Any, keys: list[str], level: _Level) -> list[dict[str, Any]]:
        found = client.query(self._name, ids=keys, output_fields=list(_FIELDS), **_now(level))
        return [dict(row) for row in found]

    def _all(self, client: Any, wanted: Float64Array, k: int, within: str, level: _Level) -> list[dict[str, Any]]:
        """The k best of all tiles within, each of them read: for as few as an index does not find k of."""
        keys: list[str] = []
        while True:  # a page begins where the one before ended: an offset reaches 16,384 at most
            after = f'id > "{keys[-1] if keys else ""}"'
            page = client.query(
                self._name,
                filter=f"({within}) and {after}" if within else after,
                limit=self.most,
                output_fields=["id"],
                **_now(level),
            )
            if not page:  # a short one may only have held a key twice
                break
            keys += sorted({str(row["id"]) for row in page})
        kept: list[dict[str, Any]] = []
        for some in _lots(keys, self._step):
            kept += self._read(client, some, level)
            scores = scores_of(np.array([row["vector"] for row in kept], np.float32), wanted)
            by_name = np.argsort(np.argsort([row["name"] for row in kept]))
            kept = [kept[i] for i in best(scores, by_name, k)]
        return kept

    def _call(self, task: Callable[[Any], _T]) -> _T:
        """What a task gives with a client that is connected; a server that does not answer is tried again for a while."""
        until = time.monotonic() + self._patience
        released = False
        for pause in _pauses():
            try:
                if self._client is None:
                    self._written = time.monotonic()  # by others, perhaps
                    self._client = self._milvus.MilvusClient(
                        uri=f"http://{self._address}", token=self._token, timeout=_CALL
                    )
                if released:
                    self._load(self._client)
                return task(self._client)
            except (StoreError, InputError):
                raise
            except Exception as error:  # pymilvus lets errors of grpc and of its own through
                if (said := _denied(error)) is not None:
                    raise StoreError(
                        f"{self._shown} does not allow this ({said}); give a name and a password that may "
                        f"({SCHEME}://user:password@host:port/collection), or have them granted the right."
                    ) from error
                if not self._passing(error):
                    raise StoreError(f"{self._shown} refuses: {_short(error)}.") from error
                released = getattr(error, "code", None) in _RELEASED
                if not released:
                    self._let_go()
                if time.monotonic() + pause > until:
                    raise StoreError(
                        f"{self._shown} does not answer, tried for {self._patience:g} s ({_short(error)}); start the server, "
                        "or check the address."
                    ) from error
                time.sleep(pause)
        raise AssertionError

    def _passing(self, error: Exception) -> bool:
        """Whether what failed may do so no more in a moment, as it is while a server starts or is gone."""
        errors = import_module("pymilvus.exceptions")
        refused = isinstance(error, (errors.ParamError, errors.DataNotMatchException)) or getattr(
            error, "is_input_error", False
        )
        mine = isinstance(error, (TypeError, KeyError, AttributeError))
        return not refused and not mine and getattr(error, "code", None) not in _REFUSED

    def _let_go(self) -> None:
        if self._client is not None:
            with suppress(Exception):  # of a connection that is lost already
                self._client.close()
            self._client = None


def parse_url(url: str) -> tuple[str, str, str]:
    """The address host:port, the token user:password or "", and the collection's name of milvus://...; InputError else."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        parts, port = urlsplit(""), None
    name = parts.path.strip("/")
    if parts.scheme != SCHEME or not parts.hostname or not port or not _COLLECTION.fullmatch(name):
        raise InputError(
            f"{url.rpartition('@')[2]} is no address of a Milvus collection; expected milvus://host:port/collection, its name of "
            "letters, digits, and underscores."
        )
    host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
    token = f"{unquote(parts.username)}:{unquote(parts.password or '')}" if parts.username else ""
    return f"{host}:{port}", token, name


def key_of(name: str) -> str:
    """What stands for a tile's name as the primary key."""
    return hashlib.blake2b(name.encode(), digest_size=16).hexdigest()


def expression(box: Box) -> str:
    """A box as Milvus filters by it."""
    south, west, north, east = box
    both = "and" if west <= east else "or"
    # Twice around the antimeridian, a tile that is nowhere must be kept out by itself.
    return (
        f"latitude >= {south!r} and latitude <= {north!r} and longitude <= 180.0 and "
        f"(longitude >= {west!r} {both} longitude <= {east!r})"
    )


def _read(description: str, shown: str) -> tuple[Kind, Structure]:
    try:
        values: Any = json.loads(description)
        if is_newer(values["format"], FORMAT):
            raise StoreError(newer_version(shown, values["format"], FORMAT))
        if values["format"] != FORMAT or values["structure"] not in get_args(Structure):
            raise ValueError("another format")
        return Kind(str(values["fingerprint"]), int(values["n_parts"]), int(values["embedding"])), values["structure"]
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(
            f"{shown} is a collection that lpn index did not make ({FORMAT}); choose another name."
        ) from error


def _said(kind: Kind) -> str:
    return f"{kind.n_parts} x {kind.embedding} numbers of model {kind.fingerprint}"


def _now(consistency: _Level = "Strong") -> dict[str, Any]:
    """What makes an answer count everything that was written before it, or until a few seconds before it."""
    return {"consistency_level": consistency, "timeout": _CALL}


def _pauses() -> Iterator[float]:
    return chain(_PAUSES, repeat(_PAUSES[-1]))


def _lots(keys: list[str], size: int) -> Iterator[list[str]]:
    return (keys[start : start + size] for start in range(0, len(keys), size))


def _denied(error: Exception) -> str | None:
    """What a server says that does not let this user in, or not do this; None of any other error.

    pymilvus tells of a wrong password as of a server that is not there, and has what the server said among the causes.
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
    details = getattr(error, "details", None)  # of gRPC's, whose text is of many lines
    said = details() if callable(details) else getattr(error, "message", "")
    text = str(said or error or type(error).__name__)
    return printable(" ".join(text.split())[:160]).rstrip(".")
