"""The same answer on every processor: libraries that choose their code by the processor they find, told not to.

Sums in another order differ in the last digit, and a comparison, a rounding to 8 bits or an iteration that stops makes
more of it. What cannot be told (OpenBLAS, numpy, numba) works on doubles where a decision follows.
"""

from __future__ import annotations

import cv2


def use_baseline_opencv() -> None:
    """OpenCV runs the code that every x86-64 processor has, without IPP, which dispatches by itself.

    Flow, sampling and blurs then give the same bits everywhere. Measured on two cores: cubic sampling takes 1.2 times
    as long, of 8-bit pictures 1.6 times; flow, blurs, resizing and the face networks as long as before.
    """
    cv2.setUseOptimized(False)
