"""Contacts and rigid-body solvers for piles. The only room that uses Newton's internals."""
