"""A flight in progress: its newest frame is located with bounded memory and latency.

    frames        pictures of a folder that receives photos, a video, or a stream; one waits, and a newer one replaces it
    telemetry     heading, height, and position by MAVLink, or from a log
    locator       the forward half of the sequence, and registration near its prediction
    run           all of these together until the flight ends; its answers are lines of GeoJSON

It imports `locate`, `files`, `maps`, and `models`; `commands` and `explorer` import it. docs/locate-a-flight.md shows its use.
"""
