"""Why a frame holds no flare, in words: what to mend, where something is to be mended."""

import numpy as np

from perception.robust.search.prepare import PreparedFrame

MOST_CLIPPED_SHARE = 0.5
"""A frame with more clipped pixels than this is called overexposed."""

NO_FAULT = ("nothing exceeds the noise", "of what exceeds the noise")
"""How reasons begin that are no fault of the frame: there is no flare in it."""


def reason_of_none(prepared: PreparedFrame, blobs: int, *, late: bool = False) -> str:
    """Say why nothing was found in a frame.

    Parameters
    ----------
    prepared
        The frame.
    blobs
        How many places exceeded the detection limit and what lies right beside them.
    late
        Whether time was up before all of them were measured.

    Returns
    -------
    One sentence.
    """
    counts_dn, black_dn = prepared.pixels.data_dn, prepared.pixels.black_level_dn
    clipped = np.count_nonzero(counts_dn >= prepared.clipped_dn) / counts_dn.size
    if clipped > MOST_CLIPPED_SHARE:
        return (
            f"{100.0 * clipped:.0f} % of the pixels are clipped (at {prepared.clipped_dn} counts): expose "
            "shorter, or correct the calibration's saturation_dn"
        )
    least, most = int(counts_dn.min()), int(counts_dn.max())
    if least == most:
        return f"all pixels read {most} counts, noise and all: no image was read out"
    if most < black_dn:
        return (
            f"the brightest pixel reads {most} counts, less than the black level, {black_dn:g}: black level "
            "or data are wrong"
        )
    if late:
        return "time was up before any flare was measured: give more"
    if blobs == 0:
        return NO_FAULT[0]
    return f"{NO_FAULT[1]}, in {blobs} place{'s'[: blobs != 1]}, nothing looks like a source"
