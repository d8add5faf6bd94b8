"""Foundations: errors, views, files, pictures, tables, logging, and the machine's resources.

It imports nothing else of `lpn`, and every package may import it. Importing it needs no installed package.
"""
