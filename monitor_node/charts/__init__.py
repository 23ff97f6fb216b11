"""Stages of an evaluated row: charts, lasting steps and drift."""
