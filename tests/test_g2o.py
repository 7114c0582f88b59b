"""Pose graphs in g2o's format: what is written is read, what is wrong is said with its line."""

import gzip

import numpy as np
import pytest
from networks import relay_recording
from pose_networks import matrix, network

from jaxvm.network.scene import build
from jaxvm.recording import (
    RecordingError,
    convert,
    find_data,
    read_recording,
    write_recording,
)
from jaxvm.recording.g2o import import_g2o, write_g2o
from jaxvm.solve.adjust import adjust

SMALL = """VERTEX_SE3:QUAT 3 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 7 1 2 3 0 0 0.7071067811865476 0.7071067811865476
EDGE_SE3:QUAT 3 7 1 2 3.5 0 0 0.7071067811865476 0.7071067811865476 \
4 1 0 0 0 0 5 0 0 0 0 6 0 0 0 7 0 0 8 0 9
"""


def test_numbers_of_a_small_file(tmp_path):
    file = tmp_path / "small.g2o"
    file.write_text(SMALL)
    recording = import_g2o(file)
    first, second = recording.model.stations
    assert (first.name, second.name) == ("3", "7")
    assert first.free == frozenset() and second.free == {"pose"}
    assert np.allclose(second.pose, [0, 0, np.pi / 2, 1, 2, 3])
    links = recording.links
    assert np.allclose(links.pose[0], [0, 0, np.pi / 2, 1, 2, 3.5])
    # Shift stands before turn in the file.
    information = np.linalg.inv(links.covariance[0])
    assert np.allclose(np.diagonal(information), [7, 8, 9, 4, 5, 6])
    assert information[3, 4] == pytest.approx(1.0)


def test_what_is_written_is_read(tmp_path):
    recording = network().recording
    for name in ("graph.g2o", "graph.g2o.gz"):
        write_g2o(recording, tmp_path / name)
        again = import_g2o(tmp_path / name)
        assert np.allclose(again.links.covariance, recording.links.covariance, rtol=1e-8, atol=0)
        for a, b in zip(again.links.pose, recording.links.pose, strict=True):
            assert np.allclose(matrix(a), matrix(b), atol=1e-12)
        for a, b in zip(again.model.stations, recording.model.stations, strict=True):
            assert np.allclose(matrix(a.pose), matrix(b.pose), atol=1e-12)
            assert a.free == b.free
        assert again.links.from_node == recording.links.from_node


def test_full_covariances_survive_a_folder(tmp_path):
    recording = network().recording
    again = read_recording(write_recording(recording, tmp_path / "links"))
    assert np.allclose(again.links.covariance, recording.links.covariance, rtol=1e-12, atol=0)
    assert again.links.name == recording.links.name
    assert [s.name for s in again.model.stations] == [s.name for s in recording.model.stations]


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("3 7 1 2", "3 8 1 2", r"line 3: vertex 8 is not in the file"),
        ("4 1 0", "4 1", r"line 3: there are 27 numbers where 28 are needed"),
        ("7 1 2 3 0", "7 one 2 3 0", r"line 2: .*one"),
        ("7 1 2 3 0", "7 nan 2 3 0", r"line 2: a number is not finite"),
        ("4 1 0 0", "4 9 0 0", r"line 3: the information matrix is not positive definite"),
        ("EDGE_SE3:QUAT", "EDGE_SE2", r"line 3: EDGE_SE2 is not read here"),
        ("QUAT 7 1 2 3 0", "QUAT 3 1 2 3 0", r"line 2: vertex 3 is there already"),
        ("3 7 1 2", "7 7 1 2", r"line 3: the edge joins vertex 7 with itself"),
        ("0 0 0 0 0 0 1\n", "0 0 0 0 0 0 0\n", r"line 1: the quaternion is zero"),
        ("VERTEX_SE3:QUAT 7", "FIX 9\nVERTEX_SE3:QUAT 7", r"FIX 9 names a vertex that is not"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(tmp_path, old, new, words):
    file = tmp_path / "bad.g2o"
    assert SMALL.count(old) == 1
    file.write_text(SMALL.replace(old, new))
    with pytest.raises(RecordingError, match=words):
        import_g2o(file)


def test_indefinite_information_can_be_mended(tmp_path):
    file = tmp_path / "bad.g2o.gz"
    file.write_bytes(gzip.compress(SMALL.replace("4 1 0 0", "4 9 0 0").encode()))
    covariance = import_g2o(file, mend=True).links.covariance[0]
    values = np.linalg.eigvalsh(np.linalg.inv(covariance))
    assert values.min() > 0.0
    # What was sound stays as it is.
    assert np.allclose(np.diagonal(covariance)[:3], 1.0 / np.array([7, 8, 9]))


def test_what_can_not_be_mended_is_refused(tmp_path):
    file = tmp_path / "bad.g2o"
    file.write_text(SMALL.replace("4 1 0 0 0 0 5", "-4 0 0 0 0 0 -5").replace(" 6 0", " -6 0"))
    with pytest.raises(RecordingError, match=r"line 3: .*--mend"):
        import_g2o(file)
    negative = " ".join(f"{-1.0 * (i == j)}" for i in range(6) for j in range(i, 6))
    head = SMALL.rpartition("0.7071067811865476")[0] + "0.7071067811865476 "
    file.write_text(head + negative + "\n")
    with pytest.raises(RecordingError, match=r"line 3: .*no positive eigenvalue"):
        import_g2o(file, mend=True)
    cut = gzip.compress(SMALL.encode())[:-12]
    (tmp_path / "cut.g2o.gz").write_bytes(cut)
    with pytest.raises(RecordingError, match="is the file whole"):
        import_g2o(tmp_path / "cut.g2o.gz")


def test_nothing_is_lost_or_overwritten(tmp_path):
    file = tmp_path / "out.g2o"
    with pytest.raises(ValueError, match="image points and ranges would be lost"):
        write_g2o(relay_recording().recording, file)
    assert not file.exists()
    source = tmp_path / "in.g2o"
    source.write_text(SMALL)
    convert(source, file)
    before = file.read_bytes()
    with pytest.raises(FileExistsError, match="already there"):
        convert(source, file)
    assert file.read_bytes() == before


def test_a_peer_reaches_the_same_optimum():
    """smallGrid3D: GTSAM 4.3 ends at 1035.851 (full logarithm)."""
    file = find_data("pose-graphs/smallGrid3D.g2o.gz")
    if file is None:
        pytest.skip("pose-graphs/smallGrid3D.g2o.gz is not there: set JAXVM_DATA")
    found = adjust(build(import_g2o(file)))
    assert 2.0 * found.cost == pytest.approx(1035.851, abs=5e-4)
