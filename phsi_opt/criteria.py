"""The limits that decide what a diagnosis says, with their units and sources.

What stands here changes verdicts, names or rankings, or is shared by several rooms.
Numbers that only say how finely something is computed (knots, bins, probes), or from
where on a word is used, stand beside the code that uses them.

The limits of the verdict were set once, before the runs that the pages report; where a
measurement or a publication set a value, it is said; the others are judgement, and the
batteries of hidden effects and measured machines are what they were judged by. Units:
"deviance" is -2 log likelihood, in which one standard error of one parameter counts as
one; "share" is a fraction of one.
"""

# --- Words that are used everywhere

# Share from which something is more than everything else together: of a missing force
# (mean square) or of the evidence that an effect takes over, of a force that is
# constant, of an effort that follows the inputs.
MOST_OF_IT = 0.5
# p-values below which chance is no explanation: of residuals that are not white (all
# channels together), of trajectories that do not share one noise.
SURE_LEVEL = 1e-3
# And below which chance is a poor one: of trajectories that differ by noise alone.
CHANCE_LEVEL = 0.05
# Standard deviations by which a size differs from zero where it is surely there.
SURE_DEVIATIONS = 2.0
# Logarithm of the Bayes factor from which an effect, or a disturbance beside white
# noise, is decisively or strongly there: odds of 100 and of 20 to 1 (Kass and Raftery,
# J. Am. Stat. Assoc. 90, 1995).
DECISIVE_EVIDENCE = 4.6
STRONG_EVIDENCE = 3.0

# --- Does a model fail, and does a larger one explain what was missing?

# Free-run error over the noise floor from which a model counts as failing.
FAILING_ERROR = 1.1
# The same where residuals are white: beside a strong missing force the floor itself is
# estimated too low. What is hidden by noise is less.
WHITE_ERROR = 1.25
# And from which its size alone says that something is missing.
SURE_ERROR = 1.5
# Steps of a quantised channel by which it must move (standard deviation) for an effect
# to be named: errors of quantisation are like noise from about one on (Widrow 1956);
# below, a complete model of an oscillator seen in three values was given dry friction.
RESOLVED_STEPS = 1.0
# Share of the squared error above the noise floor that an effect must explain to be
# named where the rest is small but not white: gravity stands in for a spring q|v| up to
# 97 % of it.
EXPLAINED_IF_NAMED = 0.97

# --- Evidence (`screening.weighing`, `diagnosis`)

# Share of what the likeliest effect so far was expected to gain, and has gained, below
# which no other is weighed: gains that were expected and weighed differ by up to three.
# Share of the likeliest model's evidence below which a search enlarges no model.
FAR_BEHIND = 0.2
# Effects that are weighed, at most; of one class that are re-fitted.
MOST_WEIGHED = 12
MOST_REFITTED = 3
# Share of the squared error above the noise floor that does as well: of the force on a
# measured machine most may be weather, people and gearing.
LEAST_ERROR_EXPLAINED = 0.3
# And below which an effect is no finding, whatever share of the force it takes over.
LEAST_FINDING = 0.05

# Sampling intervals below which a delay may be an input that does otherwise between its
# samples than was said: steps that are interpolated act half a sample too early. Two
# leave room for an error of that size beside a delay of a sample and a half.
HOLD_DELAY = 2.0

# --- Dry friction, whose corner is sharpened step by step

# Friction is sharp: a sharper corner is taken unless the deviance rises by more than
# this. A still sharper one is tried only where the deviance promises to fall by more.
SHARPER_CORNER_DEVIANCE = 4.0
# Widths of a corner within which the steps between samples are finer.
CORNER_WIDTHS = 4.0
# Steps between samples there, and half as many more from the third width on: very sharp
# friction is stiff, and with steps that are too long a body that sticks trembles.
STEPS_AT_CORNER = 8
# States at all nodes of a model with a memory beyond which its corners stay as they
# are: beside a delay of 45,000 states sharpening took 12 s.
MOST_SHARP_STATES = 30_000

# --- How hard a re-fit tries: counts, so that a loaded machine gives the same verdict

REFIT_TOLERANCE = 1e-7  # of the scaled optimality conditions
# Iterations of each way of solving: a candidate that takes more is rarely the one. Of
# 1396 solves, re-fits that succeeded had taken up to 30; lower limits change results.
REFIT_ITERATIONS = 40
# Iterations for a thorough re-fit of what a study adds: from an optimum on a grid of
# its own it converges in up to 43, or hardly ever.
THOROUGH_ITERATIONS = 100
# Intervals of a record beyond which no re-fit is begun again on finer steps.
ONE_ATTEMPT_INTERVALS = 4_000
# Root mean square distance between the states of a fit and its free run, in noise
# deviations, from which the steps between samples are made finer.
STRAYED_STATES = 0.1
# Rise of the deviance of a thorough re-fit that is another optimum, and not what finer
# steps cost.
OTHER_OPTIMUM_DEVIANCE = 10.0

# --- What a missing force looks like, in words

# Size of a force over its standard deviation below which nothing is said about it.
CERTAIN_FORCE = 1.0
# Shares of the force's mean square that a cause predicts on stretches of time left out:
CLEAR_PATTERN = 0.3  # for "it follows"
NAMED_CAUSE = 0.1  # for a row, or a word
