"""Limits of shares that were counted, one-sided, 95 %: exact for binomial counts (Clopper and Pearson)."""

_BEYOND = 0.05


def lower_limit(found: int, of: int) -> float:
    """Return the lower limit of a share."""
    from scipy.stats import beta

    return 0.0 if found == 0 else float(beta.ppf(_BEYOND, found, of - found + 1))


def upper_limit(errors: int, of: int) -> float:
    """Return the upper limit of a rate."""
    from scipy.stats import beta

    return 1.0 if errors >= of else float(beta.ppf(1.0 - _BEYOND, errors + 1, of - errors))
