"""Figures: every function draws from tables and arrays that are given to it."""
