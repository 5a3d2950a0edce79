"""The classical side: a handwritten coarse-to-fine minimiser of the scene-flow consistency energy.

Arrays in, arrays out, everything in pixels. No torch, no files.

Conventions, which hold everywhere in this project
--------------------------------------------------
* Axes: arrays are indexed ``[y, x]``; x grows to the right, y downwards; pixel (0, 0) is the centre of the top-left pixel.
* Images: float32 in [0, 1], ``(H, W, channels)`` with 1 or 3 channels; three channels are in **BGR** order, as OpenCV reads them.
* Names: camera is a word, time a digit: ``left1 right1 left2 right2``, two rectified stereo pairs.
* State: ``(5, H, W)``, in pixels of the grid that it lives on, in this order:

  ======= ========= =============================================================================================
  channel symbol    meaning
  ======= ========= =============================================================================================
  0       D1        disparity of left1: ``left1(x, y)`` matches ``right1(x - D1, y)``, D1 >= 0
  1       D2        disparity of left2, on **left2's own grid**: ``left2(x, y)`` matches ``right2(x - D2, y)``
  2       C         disparity change of left1's point from time 1 to 2; its disparity at time 2 is ``D1 + C``
  3, 4    u, v      optical flow: ``left1(x, y)`` matches ``left2(x + u, y + v)``
  ======= ========= =============================================================================================

* Flow arrays outside the state are ``(H, W, 2)`` with (u, v) last, as OpenCV has them.
* Masks are bool and say what they are true for: ``visible`` is True where the point is seen in the other image.
* Resizing a state by (sx, sy) scales D1, D2, C and u by sx, and v by sy.
"""
