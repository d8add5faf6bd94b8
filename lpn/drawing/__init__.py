"""Pictures and sentences made of results: overlays, figures, charts, and verdicts in words.

It imports `analysis` and the packages below it. The app and the reports draw with it."""
