"""Readers of posed data sets. Each module has `read(folder) -> Dataset` and `matches(folder) -> bool`."""
