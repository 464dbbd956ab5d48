"""Linear recurrences over time, in log2(T) passes over the whole array instead of T steps."""

import torch


def linear_scan(
    terms: torch.Tensor,
    factors: torch.Tensor,
    reset: torch.Tensor | None = None,
    reverse: bool = False,
) -> torch.Tensor:
    """Computes y_t = terms_t + factors_t y_{t-1}, y_{-1} = 0, along the first axis.

    Uses parallel doubling (Hillis and Steele 1986): after a pass of stride k, `total` holds the
    last 2k terms of each sum, `product` the factor of what comes before them, and `reset` whether
    that factor is cut off. Nothing is divided by a product, so factors of 0 are exact.

    Args:
        terms: (T, ...).
        factors: (T, ...).
        reset: bool, of a shape that broadcasts to theirs. Where true, y_t = terms_t, and nothing
            passes, not even a NaN.
        reverse: runs from the end instead, y_t = terms_t + factors_t y_{t+1}, y_T = 0.
    """
    if reverse:
        reset = None if reset is None else reset.flip(0)
        return linear_scan(terms.flip(0), factors.flip(0), reset).flip(0)
    total, product, stride = terms, factors, 1
    while stride < len(terms):
        first, here, before = slice(stride), slice(stride, None), slice(-stride)
        sums = torch.addcmul(total[here], product[here], total[before])
        if reset is not None:
            sums = torch.where(reset[here], total[here], sums)
            reset = torch.cat([reset[first], reset[here] | reset[before]])
        total = torch.cat([total[first], sums])
        product = torch.cat([product[first], product[here] * product[before]])
        stride *= 2
    return total
