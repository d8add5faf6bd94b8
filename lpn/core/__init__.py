"""What every other package builds on: errors, files, pictures, tables, logging, and the machine's resources.

It imports nothing of `lpn` but itself, and every package may import it."""
