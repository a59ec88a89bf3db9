"""The log as a table of the Rerun SDK: every state, and the doubles exactly.

    python dataframe.py FILE.mcap
"""

import sys
import tempfile
from pathlib import Path

import rerun as rr
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory


def main():
    log = Path(sys.argv[1])
    with open(log, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        states = [m for *_, m in reader.iter_decoded_messages(topics=["/state"])]
    with tempfile.TemporaryDirectory() as place:
        recording = Path(place) / "log.rrd"
        rr.chunk.McapReader(log).stream().write_rrd(recording, application_id="vpd", recording_id="log")
        server = rr.server.Server(datasets={"log": [recording]})
        client = server.client()
        dataset = client.get_dataset("log")
        table = dataset.reader(index="message_log_time").to_arrow_table()
        column = next(n for n in table.column_names if n.startswith("/state") and "State" in n)
        rows = [row[0] for row in table[column].to_pylist() if row]
        del dataset, client, server
    assert len(rows) == len(states), f"{len(rows)} rows of {len(states)}"
    for row, state in zip(rows, states):
        assert row["attitude"] == list(state.attitude) and row["time_s"] == state.time_s, state.time_s
        assert row["body_momentum"] == list(state.body_momentum), state.time_s
    print(f"pass  Rerun dataframe: {len(rows)} states, every double the same ({column})")


if __name__ == "__main__":
    sys.exit(main())
