"""Contacts of rigid bodies: broad phase, contact law, XPBD iterations over contacts and joints.

May import ``shared``, ``pairs`` and ``rigid``.
"""
