"""The flight of the panel's tests."""

from tests.explorer.flight.conftest import flight as flight
from tests.explorer.flight.conftest import registered as registered
