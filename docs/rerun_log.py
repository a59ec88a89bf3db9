"""A log as a recording of Rerun: rerun_log.py LOG.mcap [OUT.rrd]

Needs `pip install rerun-sdk mcap mcap-protobuf-support`. Rerun's own reader of MCAP draws the frames of a log and lists the
rest; this writes the body, its points and its surroundings, named curves, the lines of the job, and a layout of all of it.
"""

import collections
import pathlib
import sys

import numpy
import rerun as rr
import rerun.blueprint as rrb
from mcap.reader import NonSeekingReader
from mcap_protobuf.decoder import DecoderFactory

# The curves of each view: topic, field, names of the components.
XYZ = ["x", "y", "z"]
VIEWS = {
    "errors, log10": [
        ("/energy", "log10_abs_error", ["energy, J"]),
        ("/orthogonality", "log10_error", ["orthogonality"]),
        ("/momentum", "log10_drift", ["momentum, kg m²/s"]),
    ],
    "angular velocity, rad/s": [("/state", "angular_velocity", XYZ)],
    "angular momentum in the body, kg m²/s": [("/state", "body_momentum", XYZ)],
    "energy, J": [("/energy", "kinetic", ["kinetic"]), ("/energy", "potential", ["potential"]), ("/energy", "total", ["total"])],
}
# Of components: x red, y green, z blue, as the axes; then others.
COLORS = [[214, 60, 52], [60, 160, 70], [52, 96, 214], [214, 150, 30], [130, 80, 190], [30, 160, 170]]
# Rerun calls the time of its own clock log_time.
TIMELINE = "simulated_time"
LEVELS = {1: "DEBUG", 2: "INFO", 3: "WARN", 4: "ERROR", 5: "CRITICAL"}


def vector(found):
    return [found.x, found.y, found.z]


def turn(found):
    return [found.x, found.y, found.z, found.w]


def color(found):
    return [found.r, found.g, found.b, found.a]


def draw(update):
    """Boxes, balls and arrows of a scene, each in the frame in which it stands."""
    for entity in update.entities:
        at = f"space/{entity.frame_id}" if entity.frame_id != "space" else "space"
        if entity.cubes:
            rr.log(f"{at}/boxes", rr.Boxes3D(
                half_sizes=[[0.5 * edge for edge in vector(cube.size)] for cube in entity.cubes],
                centers=[vector(cube.pose.position) for cube in entity.cubes],
                quaternions=[turn(cube.pose.orientation) for cube in entity.cubes],
                colors=[color(cube.color) for cube in entity.cubes], fill_mode="solid",
            ), static=True)
        if entity.spheres:
            rr.log(f"{at}/balls", rr.Points3D(
                [vector(ball.pose.position) for ball in entity.spheres],
                radii=[0.5 * ball.size.x for ball in entity.spheres], colors=[color(ball.color) for ball in entity.spheres],
            ), static=True)
        if entity.arrows:
            def along(arrow):
                x, y, z, w = turn(arrow.pose.orientation)
                ahead = numpy.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
                return (arrow.shaft_length + arrow.head_length) * ahead

            rr.log(f"{at}/arrows", rr.Arrows3D(
                origins=[vector(arrow.pose.position) for arrow in entity.arrows],
                vectors=[along(arrow) for arrow in entity.arrows],
                radii=[0.5 * arrow.shaft_diameter for arrow in entity.arrows],
                colors=[color(arrow.color) for arrow in entity.arrows],
            ), static=True)


def main(log, out):
    columns, frames = collections.defaultdict(lambda: ([], [])), collections.defaultdict(lambda: ([], [], []))
    curves = {(topic, field): names for view in VIEWS.values() for topic, field, names in view}
    rr.init(f"vpd {log.stem}", recording_id=log.stem)
    views = [
        rrb.TimeSeriesView(name=name, contents=[f"curves{topic}/{field}" for topic, field, _ in view])
        for name, view in VIEWS.items()
    ]
    rr.save(out, default_blueprint=rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(rrb.Spatial3DView(name="body", origin="space"), rrb.TextLogView(name="job", origin="job"), row_shares=[4, 1]),
            rrb.Vertical(*views),
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE), collapse_panels=True,
    ))
    decoders, factory = {}, DecoderFactory()
    with open(log, "rb") as file:
        # In the order of the file: also of a log that is not finished.
        for schema, channel, message in NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False):
            if schema.id not in decoders:
                decoders[schema.id] = factory.decoder_for(channel.message_encoding, schema)
            found = decoders[schema.id](message.data)
            if channel.topic.startswith("/scene"):
                draw(found)
            elif channel.topic == "/tf":
                for frame in found.transforms:
                    times, places, turns = frames[frame.child_frame_id]
                    times.append(message.log_time)
                    places.append(vector(frame.translation))
                    turns.append(turn(frame.rotation))
            elif channel.topic == "/log":
                rr.set_time(TIMELINE, timestamp=numpy.datetime64(message.log_time, "ns"))
                rr.log("job", rr.TextLog(found.message, level=LEVELS.get(found.level, "INFO")))
            for topic, field in curves:
                if topic == channel.topic:
                    value = getattr(found, field)
                    value = list(value) if hasattr(value, "__len__") else [value]
                    if value:
                        times, values = columns[topic, field]
                        times.append(message.log_time)
                        values.append(value)

    def time(times):
        return [rr.TimeColumn(TIMELINE, timestamp=numpy.array(times, "datetime64[ns]"))]

    for frame, (times, places, turns) in frames.items():
        rr.send_columns(f"space/{frame}", time(times), rr.Transform3D.columns(translation=places, quaternion=turns))
    # Curves of one view differ.
    offset = {f"curves{topic}/{field}": k for view in VIEWS.values() for k, (topic, field, _) in enumerate(view)}
    for (topic, field), (times, values) in columns.items():
        at, width = f"curves{topic}/{field}", len(values[0])
        names = curves[topic, field] if width == len(curves[topic, field]) else [str(k + 1) for k in range(width)]
        colors = [COLORS[(k + offset[at]) % len(COLORS)] for k in range(width)]
        rr.log(at, rr.SeriesLines(names=names, colors=colors), static=True)
        numbers = numpy.array(values).reshape(-1)
        rr.send_columns(at, time(times), rr.Scalars.columns(scalars=numbers).partition([width] * len(times)))


if __name__ == "__main__":
    log = pathlib.Path(sys.argv[1])
    main(log, sys.argv[2] if len(sys.argv) > 2 else log.with_suffix(".rrd"))
