"""The numbers set by hand that decide what is found, each with its unit and its reason.

Steps of derivatives, sizes of samples and counts of rounds stand where they are used.
"""

from __future__ import annotations

import math

# --- which pixels say anything ---
# rad above the horizon: closer, an ordinary error of the DEM decides whether a pixel is lit
LIT_MARGIN = math.radians(1.2)
# cosine of incidence: a slope error of a degree changes brightness by 15 % there
GRAZING = math.cos(math.radians(84.0))
DARKEST = 0.3  # of an image's mean: noise of darker pixels is not divided by less than this
# of a crop's side, at either end: a window this wide keeps borders out of the spectrum and 80 % of the area
TAPER = 0.12
# rad of the Sun above facet and horizon: lower, a slope error of a degree is 7 % of brightness and more
CLEAR = math.radians(15.0)
RUGGED = 1.35  # ... and on rugged ground so many times its rms slope, since facets that seem to face the Sun are chosen by the DEM's errors
SEEN = 3  # pieces of ground that an image shows at least: of fewer, its own variance is not known, and its rows outweigh all others
CELL = 8  # px: deep shadow is averaged over squares of this side; light from the terrain differs from one to the next
SHADOWED = 12  # pixels of deep shadow in a cell of an image, below which their mean is not used
USUAL = 2.0  # standard deviations of an image's noise about the median of a cell: what stands out is sunlit
FALLS = 1.0, 0.5  # powers of the distance with which errors of horizons fall: on ten DEMs edges were between them
SHADED = 0.005  # of the squares of light shares: what less gains, errors of the DEM gain as well
OPEN = 0.05  # of them: walls of several distances that leave no more than this beyond the best are as likely
FEWEST_PIXELS = 400  # of an image in a crop: fewer do not give a spectrum

# --- registration ---
CAPTURE = 8  # px: displacements are sought up to here; further off, neighbouring craters match as well
BROAD = 6.0  # px, sigma: broader structure (albedo, film) is taken out before images are matched
# of the rendered contrast that an image shows where it matches: in files of three simulators from 0.3 where it lay there, up to 0.16 where it did not
CONTRAST = 0.25
FIELD_ORDER = 3  # degree of the polynomial over the scene that stands for a smooth field per frame

# --- covariance ---
SECTORS = 6  # directions of waves that are told apart: relief shows by its direction to the Sun
ROUNDS = 16  # of expectation-maximisation: further ones change a variance by less than 2 %

# --- evidence ---
UNITS = 12  # pieces of ground at least, over which a jackknife has the degrees of freedom for a 95 % interval
PATCH = 32  # px: crops are not cut into smaller pieces than this
SHAMS = 99  # sham residuals: p values go down to 1 %
FAULTY = 0.002  # of the squares: less is no matter of a camera, however sure
FAULTS = 0.002  # chance that any partition of a detector seems to differ where none does
DISCOVERY = 0.05  # false discovery rate
FAINT = 0.02  # of what images leave, rms: the covariance and the law are not known better, and many pixels would make that sure
SURE = 4.0  # standard errors: an effect found at this size is never called invisible
STILL = 2.6  # standard errors (99 %) of a name that was found at four, once all is registered and fitted again
CORRELATED = 16.0  # px^2 per independent sample of a residual: what is left of albedo and relief is some 4 px wide
PEAK = 6.0  # times the median of its annulus: a single wave of one frame that the spectrum of ground and noise does not have
NEAR = 1.5  # waves: the leakage of a window ends before ...
FAR = 4  # ... and about a line there is none within so many
MISFIT = 0.5  # rms residual over rms signal, beyond which the nominal model says nothing about the images
FLAT = 0.0025  # rms of lines across the detector's columns, relative to brightness, that a good flat field leaves
STANDS_OUT = (
    20.0,
    30.0,
)  # times what lies about a bright or dark pixel: facets below a pixel made up to 11, their shadows up to 22
SPECKS = 3  # pixels that stand out: one or two are on any film, and make no data strange
LINE = 18.0  # -log10 of the chance of the strongest single wave: leakage of windows made up to 15 on development data, lines from 21
BORROWED = 20.0  # waves' worth of the mean over frames in each frame's own variance: broad annuli have few waves
ADDED = 50.0  # waves' worth of a size of 1 in each piece of ground's own size
FOLDS = 16  # parts of the ground, one left out at a time: of fields over a scene an eighth of it says too much
GROUPS = 16  # of images, one left out at a time: of fewer, an error over images has too few degrees of freedom
LEVELS = (0.03, 0.1, 0.3, 1.0, 3.0)  # standard deviations of values per frame that are tried, in worthwhile sizes
TRIED = 8  # candidates per look whose held-out gain is computed, the most surprising first
TRIES = 6  # candidates per look that are fitted before the search ends: of real data three or four turn out ordinary
SIMPLER = 0.8  # of the gain of many values (one per frame, another law), with which one value for all is preferred
NOTABLE = (
    0.01  # of the weighted squares: an impossible fit that gains so much is structure, and so are lines that hold it
)
STEPS = 10  # Gauss-Newton steps at most
SHORTEST = 0.1  # of a Gauss-Newton step: where that does not help either, the values stay
LONGEST = 16.0  # times a Gauss-Newton step, where steps do not get shorter
SETTLED = 0.3  # standard errors: a smaller move is the last
