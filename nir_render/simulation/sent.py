"""What the sources of a scene send: the packets, at their true times."""

from nir_render.scene.scene import Scene
from nir_render.truth.sent import SentTruth
from perception.messages.uart import FRAME_BITS, REPEATS, meaning


def sent_packets(scene: Scene) -> list[SentTruth]:
    """Return all packets of all sources, also those that no frame shows, in the order of their starts."""
    found = []
    for name, (_, source) in scene.sources().items():
        packets = source.drive.packets
        if packets is None:
            continue
        robot, of_robot = name.split(".")
        packet_s = FRAME_BITS * REPEATS * packets.bit_s
        found += [
            SentTruth(robot, of_robot, start_s, start_s + packet_s, word, meaning(word))
            for start_s, word in packets.starts_s
        ]
    return sorted(found, key=lambda packet: (packet.start_s, packet.robot, packet.source))
