"""Contacts and the solver of piles.

The only room that uses internals of Newton and Warp. May import ``declarations``.
"""
