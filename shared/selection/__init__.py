"""No more model than a scene needs: candidates of rising cost, and the samples that tell its light.

Read in this order: candidates, samples.
May import: imaging, rendering, appearance.
"""
