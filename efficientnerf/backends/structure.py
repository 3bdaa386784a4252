"""The derivative of structural dissimilarity, 1 - SSIM (Wang et al. 2004), of a window: one formula, which torch calls and numba compiles."""


def structure_change(x, y, of_x, of_y, squares, products, c1, c2, two):
    """Half of the derivative by the pixels of a window, negated, times their number.

    x, y               pixels of a channel and those that are wanted, less their means `of_x` and `of_y`
    squares, products  means of x^2 + y^2 and of x y
    c1, c2, two        SSIM's constants and the number, of the pixels' type
    """
    means, deviations = of_x * of_x + of_y * of_y + c1, squares + c2
    same_mean, together = (two * of_x * of_y + c1) / means, (two * products + c2) / deviations
    return (y - x * together) * (same_mean / deviations) + (of_y - of_x * same_mean) * (together / means)
