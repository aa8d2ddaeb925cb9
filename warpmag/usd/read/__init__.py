"""Reads magnets, scenes and motions from USD stages, and checks them."""
