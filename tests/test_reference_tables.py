"""Tables as other programs write them: what is read, what is said, what is refused."""

import math
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest

from quad_envs.references import ColumnTable, from_csv, make_reference

HELIX = "quad/HelixTracking-v0"
T = np.arange(0.0, 10.01, 0.1)
PATH = np.stack([2 * np.sin(0.6 * T), 2 - 2 * np.cos(0.6 * T), -1 - 0.1 * T], axis=1)
PLAIN = np.column_stack([T, PATH])


def rows_of(reference, t=T):
    return reference.rows(np.asarray(t, dtype=float), np.random.default_rng(0))


def text_of(header, table=PLAIN, sep=",", end=""):
    lines = [sep.join(f"{value:.6f}" for value in row) + end for row in table]
    return "\n".join(([header] if header else []) + lines) + "\n"


def write(folder, text, name="table.csv", encoding="utf-8"):
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return path


FORMS = {
    "time in words": text_of("Timestamp, X, Y, Z"),
    "prefixes": text_of("time,p_x,p_y,p_z"),
    "long names": text_of("secs,position.x,position.y,position.z"),
    "units": text_of("t [s],x [m],y [m],z [m]"),
    "milliseconds": text_of("time_ms,x,y,z", PLAIN * [1000, 1, 1, 1]),
    "nanoseconds and millimetres": text_of("t[ns],x[mm],y[mm],z[mm]", PLAIN * [1e9, 1e3, 1e3, 1e3]),
    "semicolons": text_of("t;x;y;z", sep=";"),
    "decimal commas": text_of("t;x;y;z", sep=";").replace(".", ","),
    "tabs": text_of("t\tx\ty\tz", sep="\t"),
    "white space": text_of("t x y z", sep="   "),
    "no names": text_of("", sep=" "),
    "comments": "# exported\n% twice\n" + text_of("t,x,y,z") + "# end\n",
    "a header in a comment": text_of("# t,x,y,z", sep=" "),
    "a separator at the end": text_of("t,x,y,z,", end=","),
    "blank lines": text_of("\n t,x,y,z ").replace("\n", "\r\n\r\n"),
    "quotes": text_of('"t","x","y","z"'),
    "another order": text_of("z,t,y,x", PLAIN[:, [3, 0, 2, 1]]),
    "TUM": text_of(
        "# timestamp tx ty tz qx qy qz qw", np.column_stack([PLAIN, np.tile([0, 0, 0, 1], (T.size, 1))]), " "
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_usual_forms_of_a_table_are_the_same_trajectory(tmp_path, form):
    found = rows_of(from_csv(write(tmp_path, FORMS[form])))
    # Six digits after the point are written.
    np.testing.assert_allclose(found[:, :3], PATH, atol=1e-6)
    np.testing.assert_allclose(found[:, 6:], np.tile([0, 1], (T.size, 1)), atol=1e-6)


@pytest.mark.parametrize("name", ["a.csv", "B.CSV", "c.txt", "with spaces.tsv"])
def test_paths_are_taken_as_text_as_paths_and_from_the_home_folder(tmp_path, monkeypatch, name):
    path = write(tmp_path, text_of("t,x,y,z"), name)
    monkeypatch.setenv("HOME", str(tmp_path))
    for what in (str(path), path, f"~/{name}"):
        np.testing.assert_allclose(rows_of(make_reference(what))[:, :3], PATH, atol=1e-6)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_marked_encodings_are_read(tmp_path, encoding):
    assert rows_of(from_csv(write(tmp_path, text_of("t,x,y,z"), encoding=encoding))).shape == (T.size, 8)


@pytest.mark.parametrize("offset", [-3.0, 5.0, 1.7e9])
def test_the_episode_begins_at_the_first_row_whatever_the_clock_shows(tmp_path, offset):
    path = write(tmp_path, text_of("t,x,y,z", PLAIN + np.array([offset, 0, 0, 0])))
    reference = from_csv(path)
    # The clock's 1.7e9 s are stored to 2.4e-7 s, and the path moves at 1.2 m/s.
    np.testing.assert_allclose(rows_of(reference)[:, :3], PATH, atol=2e-6)
    np.testing.assert_allclose(reference.interval, (0.0, 10.0), atol=1e-6)


def test_t0_takes_the_clock_of_the_table_or_a_time_of_it(tmp_path):
    path = write(tmp_path, text_of("time_ms,x,y,z", (PLAIN + np.array([3, 0, 0, 0])) * [1000, 1, 1, 1]))
    np.testing.assert_allclose(from_csv(path, t0="absolute").interval, (3.0, 13.0))
    np.testing.assert_allclose(from_csv(path, t0=4.0).interval, (-1.0, 9.0))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"reference": {"t0": "absolute"}}, "from 3 to 13 s, the episode is from 0 to 10 s.*rests until 3 s"),
        ({"reference": {"t0": 5.0}}, "from -2 to 8 s, the episode is from 0 to 10 s.*before is not flown"),
        ({"time_limit": 12.0}, "from 0 to 10 s, the episode is from 0 to 12 s.*rests from 10 s"),
        ({"time_limit": 5.0}, "from 0 to 10 s, the episode is from 0 to 5 s.*time_limit='reference'"),
    ],
)
def test_a_table_that_fits_the_episode_in_part_warns_of_both_intervals(tmp_path, options, said):
    path = write(tmp_path, text_of("t,x,y,z", PLAIN + np.array([3, 0, 0, 0])))
    reference = from_csv(path, **options.pop("reference", {}))
    with pytest.warns(UserWarning, match=f"{path.name} is given {said}"):
        gym.make(HELIX, reference=reference, **options)


def test_a_table_outside_of_the_episode_is_refused(tmp_path):
    path = write(tmp_path, text_of("t,x,y,z", PLAIN + np.array([50, 0, 0, 0])))
    with pytest.raises(ValueError, match="from 50 to 60 s, the episode is from 0 to 10 s: nothing of it"):
        gym.make(HELIX, reference=from_csv(path, t0="absolute"))


def test_time_limit_reference_flies_the_whole_table(tmp_path):
    t = np.arange(241) * 0.5
    path = write(tmp_path, text_of("t,x,y,z", np.column_stack([t, 0.1 * t, 0 * t, 0 * t - 1])))
    task = gym.make(HELIX, reference=path, time_limit="reference").unwrapped.task
    assert task.episode_steps == 2400
    with pytest.raises(ValueError, match="needs a reference that has an end"):
        gym.make(HELIX, time_limit="reference")


def test_start_reference_starts_there_at_its_velocity_and_heading():
    # At t = 0 the helix moves along x with 2.4 m/s and down with 3; a heading of 0.5 rad turns the former.
    from quad_envs import Heading, Helix

    for make, n in ((gym.make, 1), (gym.make_vec, 3)):
        kwargs = {} if n == 1 else {"num_envs": n}
        env = make(HELIX, reference=Heading(Helix(), yaw=0.5), start="reference", **kwargs)
        env.reset(seed=0)
        state = np.atleast_2d(env.unwrapped.state)
        expected = [0, 0, 0, 2.4 * math.cos(0.5), -2.4 * math.sin(0.5), 3, 0, 0, 0.5, 0, 0, 0]
        np.testing.assert_allclose(state[:, :12], np.tile(expected, (n, 1)), atol=1e-12)


def test_start_reference_follows_a_random_reference_and_takes_a_box():
    env = gym.make("quad/RandomTracking-v0", start="reference")
    for seed in range(3):
        env.reset(seed=seed)
        row, state = env.unwrapped.reference[0], env.unwrapped.state
        np.testing.assert_allclose(state[:6], row[:6], atol=1e-12)
    boxed = gym.make("quad/RandomTracking-v0", start="reference", start_box=0.5)
    boxed.reset(seed=0)
    offset = np.abs(boxed.unwrapped.state[:3] - boxed.unwrapped.reference[0, :3])
    assert 0 < offset.max() <= 0.5


@pytest.mark.parametrize(
    ("axes", "vector", "heading"),
    [
        ("ned", (1, 2, 3), 0.3),
        ("frd", (1, 2, 3), 0.3),
        ("enu", (2, 1, -3), math.pi / 2 - 0.3),  # from east towards north becomes from north towards east
        ("nwu", (1, -2, -3), -0.3),
        ("FLU", (1, -2, -3), -0.3),
    ],
)
def test_axes_turn_positions_velocities_headings_and_quaternions(tmp_path, axes, vector, heading):
    t = np.array([0.0, 0.5, 1.0])
    moved = t[:, None] * [1, 2, 3]
    yaw = np.column_stack([t, moved, np.tile([1, 2, 3], (3, 1)), np.full(3, 0.3)])
    q = np.tile([0, 0, math.sin(0.15), math.cos(0.15)], (3, 1))
    for header, table in (
        ("t,x,y,z,vx,vy,vz,yaw", yaw),
        ("t,x,y,z,qx,qy,qz,qw", np.column_stack([t, moved, q])),
    ):
        found = rows_of(from_csv(write(tmp_path, text_of(header, table)), axes=axes), t)
        np.testing.assert_allclose(found[:, :3], t[:, None] * vector, atol=1e-6)
        np.testing.assert_allclose(found[:, 3:6], np.tile(vector, (3, 1)), atol=1e-6)
        # Six digits of the sine and cosine of half the angle.
        np.testing.assert_allclose(np.arctan2(found[:, 6], found[:, 7]), heading, atol=4e-6)


def test_without_a_heading_the_vehicle_looks_north_in_all_axes(tmp_path):
    path = write(tmp_path, text_of("t,x,y,z"))
    np.testing.assert_array_equal(rows_of(from_csv(path, axes="enu"))[:, 6], 0.0)


@pytest.mark.parametrize(("header", "options"), [("yaw [deg]", {}), ("yaw_deg", {}), ("yaw", {"yaw": "deg"})])
def test_headings_in_degrees_turn_the_short_way(tmp_path, header, options):
    table = np.column_stack([[0, 0.5, 1], np.zeros((3, 3)), [350, 0, 10]])
    found = rows_of(from_csv(write(tmp_path, text_of(f"t,x,y,z,{header}", table)), **options), [0.25, 0.75])
    np.testing.assert_allclose(np.degrees(np.arctan2(found[:, 6], found[:, 7])), [-5, 5], atol=1e-9)


def test_columns_that_are_not_read_are_named_and_kept_in_mind(tmp_path):
    table = np.column_stack([PLAIN, T, T])
    path = write(tmp_path, text_of("t,x,y,z,battery,roll", table))
    with pytest.warns(UserWarning, match="not read: 'battery', 'roll'"):
        assert from_csv(path).ignored == ("battery", "roll")


def test_columns_of_text_may_stand_beside(tmp_path):
    lines = text_of("t,x,y,z").splitlines()
    path = write(tmp_path, "\n".join(line + (",frame" if i == 0 else ",map") for i, line in enumerate(lines)))
    with pytest.warns(UserWarning, match="'frame'"):
        np.testing.assert_allclose(rows_of(from_csv(path))[:, :3], PATH, atol=1e-6)


def test_names_say_which_column_is_meant(tmp_path):
    path = write(tmp_path, text_of("t,north,y,z"))
    with pytest.raises(ValueError, match=r"missing \['x'\], unknown: 'north'\. names=\{'x'"):
        from_csv(path)
    np.testing.assert_allclose(rows_of(from_csv(path, names={"x": "north"}))[:, :3], PATH, atol=1e-6)


def test_a_path_above_its_start_is_taken_for_z_up_unless_the_axes_are_said(tmp_path):
    path = write(tmp_path, text_of("t,x,y,z", PLAIN * [1, 1, 1, -1]))
    with pytest.warns(UserWarning, match="positive z is down .*axes='enu'"):
        from_csv(path)
    for axes in ("ned", "nwu"):
        from_csv(path, axes=axes)


def velocities(factor):
    v = np.stack([1.2 * np.cos(0.6 * T), 1.2 * np.sin(0.6 * T), 0 * T - 0.1], axis=1)
    return np.column_stack([PLAIN, factor * v])


def test_velocities_that_contradict_the_positions_are_said(tmp_path):
    header = "t,x,y,z,vx,vy,vz"
    from_csv(write(tmp_path, text_of(header, velocities(1.0))))
    from_csv(write(tmp_path, text_of(header, velocities(1.1))))
    for factor in (0.7, -1.0, 1000.0):
        with pytest.warns(UserWarning, match="velocities contradict the positions"):
            from_csv(write(tmp_path, text_of(header, velocities(factor))))


def test_rounded_positions_do_not_contradict_exact_velocities(tmp_path):
    # At 100 Hz a position in whole centimetres has differences of 1 m/s.
    t = np.arange(0, 5, 0.01)
    table = np.column_stack([t, np.round(0.3 * t, 2), 0 * t, 0 * t, 0 * t + 0.3, 0 * t, 0 * t])
    from_csv(write(tmp_path, text_of("t,x,y,z,vx,vy,vz", table)))


def test_a_row_given_twice_is_a_pause():
    columns = {"t": [0, 1, 2, 3], "x": [0, 1, 1, 2], "y": [0, 0, 0, 0], "z": [0, 0, 0, 0]}
    found = rows_of(ColumnTable(columns), np.linspace(1, 2, 21))
    np.testing.assert_array_equal(found[:, 0], 1.0)
    np.testing.assert_array_equal(found[:, 3:6], 0.0)


def test_an_axis_that_rests_does_not_move_with_the_others():
    columns = {"t": [0, 1, 2, 3], "x": [0, 1, 2, 3], "y": [0, 0, 0, 1], "z": [0, 0, 0, 0]}
    np.testing.assert_array_equal(rows_of(ColumnTable(columns), np.linspace(0, 2, 41))[:, 1], 0.0)


def polynomials():
    """A segment x = 0 to 1 in 2 s and one that climbs from z = 0 to 0.5, at rest between them."""
    rest = [0.0] * 8
    rise = [0, 0, 0, 0, 35 / 2**4, -84 / 2**5, 70 / 2**6, -20 / 2**7]
    up = [0.5 * c for c in rise]
    pieces = [[2.0, *rise, *rest, *rest, *rest], [2.0, 1.0, *rest[1:], *rest, *up, 0.4, *rest[1:]]]
    names = ["duration", *(f"{axis}^{k}" for axis in ("x", "y", "z", "yaw") for k in range(8))]
    return ",".join(names) + ",\n" + "\n".join(",".join(map(repr, piece)) for piece in pieces) + "\n"


def test_crazyswarm_polynomials_have_z_up_and_rest_at_their_end(tmp_path):
    reference = from_csv(write(tmp_path, polynomials()))
    found = rows_of(reference, [0.0, 1.0, 2.0, 3.0, 4.0, 9.0])
    np.testing.assert_allclose(found[:, 0], [0, 0.5, 1, 1, 1, 1], atol=1e-12)
    np.testing.assert_allclose(found[:, 2], [0, 0, 0, -0.25, -0.5, -0.5], atol=1e-12)
    np.testing.assert_allclose(found[[1, 3], 3:6], [[35 / 32, 0, 0], [0, 0, -35 / 64]], atol=1e-12)
    np.testing.assert_allclose(np.arctan2(found[:, 6], found[:, 7]), [0, 0, -0.4, -0.4, -0.4, -0.4])
    assert reference.interval == (0.0, 4.0)
    h = 1e-6
    slope = (rows_of(reference, [1.3 + h]) - rows_of(reference, [1.3 - h]))[0, :3] / (2 * h)
    np.testing.assert_allclose(rows_of(reference, [1.3])[0, 3:6], slope, atol=1e-8)


def test_columns_at_hand_are_a_table_too():
    columns = dict(zip(("time", "X", "Y", "Z"), PLAIN.T, strict=True))
    np.testing.assert_allclose(rows_of(ColumnTable(columns))[:, :3], PATH, atol=1e-12)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"t": [0, 1], "x": [0, 1], "y": [0, 1]}, "missing \\['z'\\]"),
        ({"t": [0, 1], "x": [0, 1], "y": [0, 1], "z": [0, 1, 2]}, "equally long, z is not"),
        ({"t": [0, 1], "x": [0, "a"], "y": [0, 1], "z": [0, 1]}, "column 'x' must be a list of numbers"),
        ({"t": [0, 1], "x": [0, math.nan], "y": [0, 1], "z": [0, 1]}, "row 1: x must be a finite"),
        ({"t": [0, 0], "x": [0, 1], "y": [0, 1], "z": [0, 1]}, "row 1: time must increase"),
    ],
)
def test_columns_that_are_no_trajectory_are_refused(columns, message):
    with pytest.raises(ValueError, match=message):
        ColumnTable(columns)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,x,y,z\n0,0,0,0\n0.1," + "1" * 200_000 + ",0,0\n", "line 3: a cell is longer"),
        ('t,x,y,z\n0,0,0,0\n0.1,"0,0,0\n', "line 3: a quote is not closed"),
        ("t,x,y,z,x\n0,0,0,0,0\n1,0,0,0,0\n", "names x twice, as 'x' and 'x'; give one of them another name"),
        ("t,x,y\n0,0,0\n1,0,0\n", r"missing \['z'\], unknown: none\. names={'z': 'what it is called'} says"),
        ("t,x,y,z,pos_x\n0,0,0,0,0\n1,0,0,0,0\n", "names x twice, as 'x' and 'pos_x'"),
        ("t,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n1,0,0,0,0,0,0,3\n", "line 3: a quaternion of length 3"),
        ("t,x,y,z,qx\n0,0,0,0,0\n", "all of qx, qy, qz, qw or none"),
        ("t [h],x,y,z\n0,0,0,0\n1,0,0,0\n", "unknown unit of column 't \\[h\\]'; known: s, sec"),
        ("0,0,0\n1,0,0\n", "line 1: 3 columns without names; give the table a header"),
        ("t,x,y,z\n0,0,0,0\n1000,0,0,0\n2000,0,0,0\n", "line 3: a gap of 1000 s .*time_unit='ms'"),
        ("t,x,y,z\n0,0,0,0\n0.1,0,0,0,7\n", "line 3: 5 cells where the header names 4"),
        ("t,x,y,z\n0,0,\0,0\n", "line 2: no text but binary data"),
        ("duration,x^0,\n1,0,\n", "polynomials need .* missing"),
        (polynomials().replace("2.0,", "-2.0,", 1), "line 2: duration must be a number > 0 s, got '-2.0'"),
        ("\n\n# nothing\n", "header"),
    ],
)
def test_a_broken_table_is_refused_with_file_and_line(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(ValueError, match=message) as error:
        from_csv(path)
    assert str(path) in str(error.value) and len(str(error.value)) < 600


def test_another_encoding_is_refused_with_its_line(tmp_path):
    path = write(tmp_path, "t,x,y,z\n0,0,0,0\n# Höhe\n", encoding="latin-1")
    with pytest.raises(ValueError, match="line 3: no UTF-8 text; save the table as UTF-8"):
        from_csv(path)


def test_long_cells_and_names_are_not_repeated(tmp_path):
    for text in ("t,x,y,z\n0," + "a" * 100_000 + ",0,0\n", "t,x,y," + "b" * 100_000 + "\n0,0,0,0\n"):
        with pytest.raises(ValueError) as error:
            from_csv(write(tmp_path, text))
        assert len(str(error.value)) < 600


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"axes": "nedd"}, "unknown axes 'nedd'; did you mean 'ned'"),
        ({"axes": 3}, "unknown axes"),
        ({"yaw": "degree"}, "did you mean 'degrees'"),
        ({"yaw": []}, "unknown yaw"),
        ({"time_unit": "min"}, "unknown time_unit 'min'"),
        ({"t0": "start"}, "t0 must be 'first'"),
        ({"t0": math.nan}, "t0 must be"),
        ({"max_gap": 0.0}, "max_gap must be a number > 0"),
        ({"names": {"w": "x"}}, "not 'w'"),
        ({"names": {"x": "w"}}, "there is no column 'w'; there are 't'"),
    ],
)
def test_options_of_a_table_are_checked(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        from_csv(write(tmp_path, text_of("t,x,y,z")), **options)


def test_files_that_are_none_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"missing\.csv"):
        make_reference("missing.csv")
    with pytest.raises(IsADirectoryError):
        from_csv(tmp_path)
    with pytest.raises(ValueError, match="not a regular file"):
        from_csv("/dev/zero")


def test_tables_travel_to_other_processes(tmp_path):
    reference = from_csv(write(tmp_path, text_of("t,x,y,z")))
    np.testing.assert_array_equal(rows_of(pickle.loads(pickle.dumps(reference))), rows_of(reference))


def test_tables_with_random_mistakes_are_read_or_refused_and_nothing_else(tmp_path):
    rng = np.random.default_rng(0)
    pieces = [b",", b";", b"\n", b'"', b"nan", b"1e999", b"#", b"\t", b"-", b"\0", b"\xff", b"[deg]", b"t"]
    forms = [text.encode() for text in (*FORMS.values(), polynomials())]
    for k in range(400):
        data = bytearray(forms[k % len(forms)])
        for _ in range(rng.integers(1, 4)):
            # Half of the mistakes are in the header.
            at = int(rng.integers(60 if rng.random() < 0.5 else len(data)))
            data[at : at + int(rng.integers(0, 3))] = pieces[rng.integers(len(pieces))]
        (tmp_path / "table.csv").write_bytes(bytes(data))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                found = rows_of(from_csv(tmp_path / "table.csv"))
            except ValueError as error:
                assert "table.csv" in str(error) and len(str(error)) < 600
            else:
                assert np.isfinite(found).all()
