"""What must not get worse: measures of the whole project, each compared with its committed baseline.

A module here that has `MEASURES` is found by itself; `tools.keep.measures` says what a measure is. Each measure has a file of its
own in `baseline/`.
"""
