"""File formats: pure reading and writing, arrays on one side and files on the other.

* :mod:`~cgsf.formats.images`: 8- and 16-bit images, grey, colour, with or without alpha
* :mod:`~cgsf.formats.kitti_png`: KITTI's 16-bit disparity and flow maps
* :mod:`~cgsf.formats.flo`, :mod:`~cgsf.formats.pfm`: Middlebury flow and portable float maps
* :mod:`~cgsf.formats.npz`: named arrays without pickle
* :mod:`~cgsf.formats.ply`: point clouds with 3D motion

Every reader checks the sizes that a header claims against the file before it allocates, and raises
:class:`~cgsf.errors.InputError` with one line for a file that is missing, truncated or of another kind.
Every writer is atomic. Unknown values are NaN in arrays, whatever the file's own code for them is.
"""
