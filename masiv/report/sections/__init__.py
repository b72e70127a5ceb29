"""Sections of the report: each takes a page and adds its heading, tables and pictures."""
