"""Which model a scene needs: candidates of rising cost, kept where held-out frames fit better.

Read in this order: candidates.
May import: appearance.
"""
