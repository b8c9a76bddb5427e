"""The row of a table of references: what stands where."""

# What a reference gives: p_ref 3 (in observations p_ref - p), v_ref 3 (inertial), sin psi_ref, cos psi_ref.
N_REFERENCE = 8
SINE, COSINE = 6, 7  # of psi_ref
TURN_RATE = 8  # psi_dot, rad/s
HEADING = 9  # psi_ref, rad
N_TABLE = 10

# A row of what observations preview, in words of float32: the position in doubles, from which a vehicle's is
# subtracted, then v_ref, sin psi_ref and cos psi_ref as they are seen; the last word is empty.
SEEN = 2 * 3
N_PREVIEW = 12
