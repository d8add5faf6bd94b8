"""The commands of flights: flight, map, locate, and locate --live.

`lpn.cli` finds them by the entry points `lpn.commands`, and imports nothing of them. They import what they need when they run.
"""
