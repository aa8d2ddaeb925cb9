"""Magnetic moments on a device: fields, induction, forces and torques, from arrays.

May import ``declarations`` and ``shapes``. Neither Newton nor USD.
"""
