"""Thousands of labelled clips of a sheet: an explicit simulator of eight sheets at a time."""
