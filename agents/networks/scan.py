"""Linear recurrences over time, in log2(T) passes over the whole array instead of T steps."""

import torch


def scan(
    terms: torch.Tensor,
    factors: torch.Tensor,
    cut: torch.Tensor | None = None,
    reverse: bool = False,
) -> torch.Tensor:
    """y_t = terms_t + factors_t y_{t-1}, y_{-1} = 0, along the first axis; with `reverse` from the
    end on, y_t = terms_t + factors_t y_{t+1}, y_T = 0.

    `terms` and `factors` are (T, ...). Where `cut`, bool of a shape that fits theirs, y_t is
    terms_t: nothing passes, not even a NaN.

    Computed by doubling (Hillis and Steele 1986): after a pass of stride k, y_t holds the last 2k
    terms of its sum, its product what comes before them counts for, and its cut whether anything
    does. Nothing is divided by a product, so zeros among factors are exact.
    """
    if reverse:
        cut = None if cut is None else cut.flip(0)
        return scan(terms.flip(0), factors.flip(0), cut).flip(0)
    total, product, stride = terms, factors, 1
    while stride < len(terms):
        first, here, before = slice(stride), slice(stride, None), slice(-stride)
        sums = torch.addcmul(total[here], product[here], total[before])
        if cut is not None:
            sums = torch.where(cut[here], total[here], sums)
            cut = torch.cat([cut[first], cut[here] | cut[before]])
        total = torch.cat([total[first], sums])
        product = torch.cat([product[first], product[here] * product[before]])
        stride *= 2
    return total
