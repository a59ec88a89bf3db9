"""Checks the log of the dipole with the readers that users have, and recomputes what it claims.

    python check_log.py FILE.mcap SAMPLES EPOCH_NS

The job must be the dipole on a stick of scenarios/dipole.json with every channel on; SAMPLES is
how many it was to log, EPOCH_NS the log time of its start. One line per check; exit code 1 if one
failed.
"""

import json
import sys
from xml.etree import ElementTree

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

MOMENTS = np.array([1.01, 1.0, 0.01])
E3 = np.array([0.0, 0.0, 1.0])
SOURCE = np.array([0.0, 0.0, -1.5])
CHARGES = [(1.0, np.array([0.0, 0.1, -1.0])), (-1.0, np.array([0.0, -0.1, -1.0]))]
EVERY_SAMPLE = ["/state", "/energy", "/orthogonality", "/momentum", "/tf"]
ONCE = ["/scene/body", "/scene/sources"]

results = []


def check(name, good, detail=""):
    results.append(bool(good))
    print(f"{'pass' if good else 'FAIL'}  {name}{': ' if detail else ''}{detail}")


def energy(attitude, momentum):
    potential = E3 @ attitude @ E3
    for charge, point in CHARGES:
        potential += charge / np.linalg.norm(attitude @ point - SOURCE)
    return 0.5 * np.sum(momentum**2 / MOMENTS) + potential


def rotation(q):
    """The matrix of a quaternion (w, x, y, z), column by column from q e q*."""
    w, v = q[0], q[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return (w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * cross


def largest(values):
    return max(values, default=float("nan"))


def check_frame(reader, summary, topics, samples, epoch):
    """Everything around the numbers: counts, times, index, metadata."""
    counts = {topic: len(messages) for topic, messages in topics.items()}
    for topic in EVERY_SAMPLE:
        check(f"{topic} has every sample", counts.get(topic) == samples, f"{counts.get(topic, 0)}")
    check("/solver has every sample but the start", counts.get("/solver") == samples - 1,
          f"{counts.get('/solver', 0)}")
    for topic in ONCE:
        check(f"{topic} is sent once", counts.get(topic) == 1, f"{counts.get(topic, 0)}")
    check("the statistics count every message",
          summary.statistics.message_count == sum(counts.values()),
          f"{summary.statistics.message_count}")
    starts = [chunk.message_start_time for chunk in summary.chunk_indexes]
    check("no chunk starts before the epoch", starts and min(starts) >= epoch,
          f"{len(starts)} chunks")
    check("no chunk is empty", all(chunk.message_index_offsets for chunk in summary.chunk_indexes))
    check("every schema is protobuf",
          all(schema.encoding == "protobuf" for schema in summary.schemas.values()))
    names = [record.name for record in reader.iter_metadata()]
    check("the job is first and the outcome last in the metadata",
          names[:1] == ["vpd.job"] and names[-1:] == ["vpd.outcome"], ", ".join(names))
    outcome = [record.metadata for record in reader.iter_metadata() if record.name == "vpd.outcome"]
    check("the outcome is a success", outcome and outcome[-1].get("state") == "succeeded",
          json.dumps(outcome[-1])[:120] if outcome else "none")
    attachments = {item.name: item.data for item in reader.iter_attachments()}
    try:
        good = isinstance(json.loads(attachments["scenario.json"]), dict)
    except (KeyError, ValueError):
        good = False
    check("the attachment scenario.json parses", good)
    charts = [attachments.get(name, b"") for name in ("energy.svg", "orthogonality.svg")]
    roots = [ElementTree.fromstring(chart).tag if chart else "none" for chart in charts]
    check("the charts are attached", all(root.endswith("svg") for root in roots),
          ", ".join(f"{len(chart)} bytes" for chart in charts))


def check_numbers(topics):
    """What the log claims, recomputed from /state."""
    states = [message for _, message in topics.get("/state", [])]
    attitudes = [np.array(state.attitude).reshape(3, 3) for state in states]
    momenta = [np.array(state.body_momentum) for state in states]
    energies = [message for _, message in topics.get("/energy", [])]
    defects = [message for _, message in topics.get("/orthogonality", [])]
    frames = [message.transforms[0] for _, message in topics.get("/tf", [])]
    spatial = [np.array(message.spatial_momentum) for _, message in topics.get("/momentum", [])]

    spectral = [np.linalg.norm(g.T @ g - np.eye(3), 2) for g in attitudes]
    off = largest(abs(mine - theirs.error) for mine, theirs in zip(spectral, defects))
    # Both round products of numbers near 1: a few units in the last place apart.
    check("orthogonality agrees with the states", off <= 1e-15,
          f"off by {off:.1e}, largest {largest(spectral):.1e}")

    mine = [energy(g, mu) for g, mu in zip(attitudes, momenta)]
    off = largest(abs(h - theirs.total) for h, theirs in zip(mine, energies))
    check("total energy agrees with the states", off <= 1e-13, f"off by {off:.1e}")
    off = largest(abs(h - mine[0] - theirs.error) for h, theirs in zip(mine, energies))
    check("energy error agrees with the states", off <= 1e-13,
          f"off by {off:.1e}, largest {largest(abs(theirs.error) for theirs in energies):.1e}")
    off = largest(abs(e.kinetic + e.potential - e.total) for e in energies)
    check("total energy is kinetic plus potential", off <= 1e-15, f"off by {off:.1e}")

    off = largest(np.max(np.abs(g @ mu - pi)) for g, mu, pi in zip(attitudes, momenta, spatial))
    check("spatial momentum agrees with the states", off <= 1e-14, f"off by {off:.1e}")

    off = largest(np.max(np.abs(rotation(np.array(state.quaternion)) - g))
                  for state, g in zip(states, attitudes))
    check("quaternions agree with the attitudes", off <= 1e-14, f"off by {off:.1e}")
    along = [np.dot(a.quaternion, b.quaternion) for a, b in zip(states, states[1:])]
    below = sum(state.quaternion[0] < 0 for state in states)
    check("quaternions have no jumps in sign", min(along) >= 0 and states[0].quaternion[0] >= 0, f"w < 0 in {below}")
    turns = [np.array([f.rotation.w, f.rotation.x, f.rotation.y, f.rotation.z]) for f in frames]
    same = all(np.array_equal(turn, np.array(s.quaternion)) for turn, s in zip(turns, states))
    check("frames carry the same quaternions", turns and same)
    check("frames go from space to body",
          all((f.parent_frame_id, f.child_frame_id) == ("space", "body") for f in frames))

    logs = [e.log10_abs_error for e in energies] + [d.log10_error for d in defects]
    check("logarithms are finite and not below -20", np.all(np.isfinite(logs)) and min(logs) >= -20)


def check_times(messages, topics, epoch):
    """Log times, in the order of the file."""
    logged = [message.log_time for message in messages]
    check("log time is publish time", all(m.log_time == m.publish_time for m in messages))
    check("log time never falls", all(a <= b for a, b in zip(logged, logged[1:])))
    off = largest(abs(m.log_time - epoch - s.time_s * 1e9) for m, s in topics.get("/state", []))
    check("log time is the epoch plus simulated time", off <= 1.0, f"off by {off:.2f} ns")


def main():
    path, samples, epoch = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    topics = {}
    messages = []
    try:
        with open(path, "rb") as file:
            reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            summary = reader.get_summary()
            for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
                topics.setdefault(channel.topic, []).append((message, decoded))
                messages.append(message)
            check_frame(reader, summary, topics, samples, epoch)
        check_times(messages, topics, epoch)
        check_numbers(topics)
    except (OSError, McapError, AttributeError) as error:
        check("the log can be read", False, repr(error))
    failed = results.count(False)
    print(f"{len(results) - failed} passed, {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
