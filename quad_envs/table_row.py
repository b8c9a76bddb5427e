"""The row of a table of references: what stands where."""

# What a reference gives: p_ref 3 (in observations p_ref - p), v_ref 3 (inertial), sin psi_ref, cos psi_ref.
N_REFERENCE = 8
SINE, COSINE = 6, 7  # of psi_ref
TURN_RATE = 8  # psi_dot, rad/s
HEADING = 9  # psi_ref, rad
N_TABLE = 10
