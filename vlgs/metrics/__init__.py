"""How a number is computed. Every protocol carries a NAME and a VERSION that go into each result.

A version is raised whenever a change can move a number, so that no table mixes two of them.
"""
