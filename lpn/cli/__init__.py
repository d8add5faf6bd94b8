"""The subcommands of `lpn`, each a dataclass of its options with `run`. They import what they need when they run."""
