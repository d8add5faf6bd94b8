"""Milvus (the extra `cluster`): an index in a collection on a server, milvus://[user:password@]host:port/collection.

A collection has the fields id (primary key: a hash of the tile's name, which needs no escaping in expressions), name, vector (n D
numbers, inner product), latitude, and longitude. Its description holds the kind. `?hnsw` after a new collection's name makes an
approximate, faster one; otherwise every vector is compared. `add` is an upsert: repeat it after an error.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any, cast
from urllib.parse import unquote, urlsplit

import msgspec
import numpy as np

from lpn.core.arrays import Float32Array, Float64Array
from lpn.core.errors import InputError, StoreError
from lpn.core.files import printable
from lpn.descriptors.store import DescriptorKind
from lpn.index.base import ID_LENGTH, DegreeBox, Index, TileRow, Tiles

FORMAT = "lpn-milvus/1:"
_FIELDS = ("id", "name", "vector", "latitude", "longitude")
# Latitude and longitude of a tile without a position, outside of every box, as Milvus 2.3 has no null.
_NOWHERE = 1000.0
# Tiles in a message, far below a server's limit of 64 MB, and seconds of a call.
_STEP, _SECONDS = 500, 30.0


class MilvusIndex(Index):
    """A collection on a Milvus server, 2.3 or later, which is made if it is missing and a kind is given.

    Raises:
        StoreError: when there is no such server or collection, or it holds something else.
        InputError: when the address is malformed.
        ModuleNotFoundError: when pymilvus is not installed.
    """

    engine = "milvus"
    most = 16384

    def __init__(self, url: str, kind: DescriptorKind | None = None) -> None:
        self._milvus = cast(Any, import_module("pymilvus"))
        logging.getLogger("pymilvus").setLevel(logging.CRITICAL + 1)  # it logs a traceback of each error
        parts, port = urlsplit(url), None
        with suppress(ValueError):  # of a port that is no number
            port = parts.port
        self._name, self._hnsw, self._url = parts.path.strip("/"), parts.query == "hnsw", url.rpartition("@")[2]
        if not (parts.hostname and port and self._name.isidentifier()):
            raise InputError(
                f"{self._url} is not the address of a Milvus collection; expected milvus://host:port/collection, its name of "
                "letters, digits, and underscores."
            )
        if parts.query not in ("", "hnsw"):
            raise InputError(f"{self._url} ends in ?{parts.query}; expected ?hnsw, or nothing after the collection.")
        uri = f"http://{parts.netloc.rpartition('@')[2]}"
        token = f"{unquote(parts.username)}:{unquote(parts.password or '')}" if parts.username else ""
        with self._told():
            self._client = self._milvus.MilvusClient(uri=uri, token=token, timeout=_SECONDS)
        try:
            self.kind = self._opened(kind)
            self._call("load_collection", timeout=None)
        except BaseException:
            self.close()
            raise

    def _opened(self, kind: DescriptorKind | None) -> DescriptorKind:
        """Return the kind of the collection, which is made if it is missing and a kind is given."""
        if not self._call("has_collection"):
            if kind is None:
                raise StoreError(f"{self._url} has no such collection; make it with lpn index.")
            described = FORMAT + msgspec.json.encode(kind).decode()
            types, client = self._milvus.DataType, self._client
            schema = client.create_schema(auto_id=False, enable_dynamic_field=False, description=described)
            schema.add_field("id", types.VARCHAR, is_primary=True, max_length=32)
            schema.add_field("name", types.VARCHAR, max_length=4 * ID_LENGTH)
            schema.add_field("vector", types.FLOAT_VECTOR, dim=kind.numbers)
            schema.add_field("latitude", types.DOUBLE).add_field("longitude", types.DOUBLE)
            self._call("create_collection", schema=schema, consistency_level="Strong")
        described = str(self._call("describe_collection").get("description", ""))
        try:
            held = msgspec.json.decode(described.removeprefix(FORMAT), type=DescriptorKind)
        except (ValueError, RecursionError, InputError) as error:
            raise StoreError(
                f"{self._url} is a collection that lpn index did not make; choose another name."
            ) from error
        if kind not in (None, held):
            raise StoreError(f"{self._url} holds {held}, and these would be {kind}; choose another collection.")
        if not (indexes := self._call("list_indexes")):
            hnsw = {"index_type": "HNSW", "params": {"M": 32, "efConstruction": 200}}
            built = self._client.prepare_index_params()
            built.add_index("vector", metric_type="IP", **(hnsw if self._hnsw else {"index_type": "FLAT"}))
            self._call("create_index", built)
        elif self._hnsw and self._call("describe_index", indexes[0])["index_type"] != "HNSW":
            raise StoreError(f"{self._url} was made without ?hnsw; leave it out, or choose another collection.")
        return held

    def _add(self, names: list[str], vectors: Float32Array, places: Float64Array) -> None:
        """Add tiles. Each message is atomic, so an error may leave some of the tiles added."""
        degrees, flat = np.where(np.isnan(places), _NOWHERE, places), vectors.reshape(len(names), -1)
        for start in range(0, len(names), _STEP):
            some = slice(start, start + _STEP)
            tiles = zip(names[some], flat[some].tolist(), *degrees[some].T.tolist(), strict=True)
            rows = [dict(zip(_FIELDS, (_key(tile[0]), *tile), strict=True)) for tile in tiles]
            self._call("upsert", rows)

    def _nearest(self, wanted: Float64Array, k: int, box: DegreeBox | None) -> Tiles:
        """See `Index._nearest`; hnsw may return too few tiles, for example in a box. Ties come in any order, so sort by name."""
        options: dict[str, Any] = {"limit": k, "consistency_level": "Session", "filter": _inside(box)}
        options["search_params"] = {"metric_type": "IP", "params": {"ef": max(128, k)}}
        hits = self._call("search", data=[wanted.astype(np.float32).tolist()], **options)[0]
        rows = self._read([str(hit["id"]) for hit in hits], level="Session")
        return self._tiles(sorted(rows), rows)

    def _rows(self, names: Sequence[str], vectors: bool = True) -> dict[str, TileRow]:
        return self._read([_key(name) for name in names], vectors)

    def _read(self, keys: Sequence[str], vectors: bool = True, level: str = "Strong") -> dict[str, TileRow]:
        """Read tiles by their keys, in messages of bounded size."""
        rows: dict[str, TileRow] = {}
        fields = [field for field in _FIELDS[1:] if vectors or field != "vector"]
        for start in range(0, len(keys), _STEP):
            ids = list(keys[start : start + _STEP])
            for row in self._call("query", consistency_level=level, ids=ids, output_fields=fields):
                at = [np.nan if row[one] == _NOWHERE else row[one] for one in ("latitude", "longitude")]
                rows[str(row["name"])] = row.get("vector"), at
        return rows

    def count(self) -> int:
        """See `Index.count`."""
        rows = self._call("query", filter="", output_fields=["count(*)"], consistency_level="Strong")
        return int(rows[0]["count(*)"])

    def close(self) -> None:
        """See `Index.close`."""
        with suppress(Exception):  # the connection may be lost already
            self._client.close()

    def _call(self, method: str, *given: object, **options: object) -> Any:
        """Call a method of the client on the collection."""
        with self._told():
            return getattr(self._client, method)(self._name, *given, **{"timeout": _SECONDS, **options})

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Turn errors of the server and of the connection into one sentence."""
        try:
            yield
        except Exception as error:  # pymilvus raises its own errors and those of grpc, whose text has many lines
            text = getattr(error, "message", "") or str(error) or type(error).__name__
            raise StoreError(
                f"{self._url} refuses or does not answer ({printable(' '.join(str(text).split())[:160]).rstrip('.')}); check the "
                "server, the address, and your rights (milvus://user:password@host:port/collection), and run this again."
            ) from error


def _inside(box: DegreeBox | None) -> str:
    """Format a box as a filter expression."""
    if box is None:
        return ""
    south, west, north, east = box
    both = "and" if west <= east else "or"  # across the antimeridian, "or" would include tiles without a position
    both = f"longitude <= 180.0 and (longitude >= {west!r} {both} longitude <= {east!r})"
    return f"latitude >= {south!r} and latitude <= {north!r} and {both}"


def _key(name: str) -> str:
    return hashlib.blake2b(name.encode(), digest_size=16).hexdigest()
