"""The same answer on every processor: libraries that choose their code by the processor they find, told not to.

Sums in another order differ in the last digit, and a comparison, a rounding to 8 bits or an iteration that stops makes
more of it. What cannot be told (OpenBLAS, numpy, numba) works on doubles where a decision follows.
"""

from __future__ import annotations

import os

import cv2


def use_baseline_opencv() -> None:
    """OpenCV runs the code that every x86-64 processor has, without IPP, which dispatches by itself. To be called
    before OpenCV has computed anything: it asks for IPP once, and other threads than this one by the variable alone.

    Flow, sampling and blurs then give the same bits everywhere. Measured on two cores: cubic sampling takes 1.2 times
    as long, of 8-bit pictures 1.6 times; flow, blurs, resizing and the face networks as long as before.
    """
    logging, variable = cv2.utils.logging, "OPENCV_IPP"
    level = logging.setLogLevel(logging.LOG_LEVEL_ERROR)  # it warns of the variable
    before = os.environ.get(variable)
    os.environ[variable] = "disabled"
    cv2.setUseOptimized(False)
    logging.setLogLevel(level)
    if before is None:
        del os.environ[variable]  # other programs may do as they like
    else:
        os.environ[variable] = before
