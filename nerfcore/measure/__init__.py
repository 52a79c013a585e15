"""Measures of a mesh with their uncertainty, drawings to scale, reports and comparisons.

Constants that are not a standard's or a formula's were set by reasoning and not tuned; what the intervals promise is held
by simulation in the tests.
"""
