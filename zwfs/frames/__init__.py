"""Camera files to phase.

`files` reads and writes, `registration` locates the pupils, `pipeline` reconstructs, `verdict` judges the result,
and `order` finds which image has which phase shift.
"""

from zwfs.frames import files, order, pipeline, registration
from zwfs.frames.order import order_of_images

__all__ = ["files", "order", "order_of_images", "pipeline", "registration"]
