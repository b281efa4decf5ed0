"""All constants of the decision. docs/methods.md says what they are for; none is a setting.

"Chosen" is how: on the kitchen, fr1_rpy, nordland_1, office_handheld_loop and floors 3 to 12 of the tower, or by hand.
"""

PRECISION = 0.99  # the share of the accepted loops that should be right

# Visits
RECENT = 20  # frames that are no candidates where nothing says how old one must be: as many as a line has steps
AWAY = 2  # frames in a row that differ from a place end a visit to it; by hand: one black frame does not
AGES = 100  # frames: the greatest age of a frame of the same visit that is looked at
SETTLED = 0.05  # the remaining share of the fall from the similarity of neighbors to that of different places
DRIFT = 0.1  # of the distance traveled: more than the usual error of odometry
FAR_M = 4.0  # at this distance and beyond, two frames show different places: twice that of one place

LOOKED_BACK = 1000  # frames of a stretch that a robot's frame may continue

# Lines
LENGTHS = (10, 20)  # steps of a line
VELOCITIES = (0.8, 1.2, 0.1)  # least, greatest and step, as shares of the speed; OpenSeqSLAM's
SPEEDS = (0.5, 2.0, 0.25, 4.0)  # references for a query, of two traverses of which none fits at the usual speed
WINDOW = 5  # references to each side of a line; by hand
MIDDLE = 4  # steps in the middle of a line, which must be on it too
LEAST_PIECES = 30  # squares of the length of a line among all pairs, which show what chance does
TAIL = 0.1  # share of the decoys that the tail is fitted to, and at least so many:
LEAST_TAIL = 5

# Points
SURE = 1.5  # the evidence of a single image that is a loop; once is not enough: the windows of a facade repeat
SURE_AMONG_ALIKE = 2.5  # the same, where places look alike
DECADE = 0.5  # so much more evidence is wrong a tenth as often
ALIKE = 0.25  # of the matches with enough points: if more of them agree only in part, places look alike
LEAST_VERIFIED = 3  # fewer verified matches of a stretch do not tell whether they agree only in part; by hand
AGAINST = 0.01  # a stretch falls if the ratio of the likelihoods is less; by hand
SAMPLE = 40  # pairs of a stretch, or of different places, from which it is found what these have in common
DOUBTFUL = 0.1  # a smaller share of verified loops is rare where light and season are the same; it is said
