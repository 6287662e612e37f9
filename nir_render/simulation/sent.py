"""Who sends what when: the packets of all sources, as they are."""

from collections.abc import Iterator

from nir_render.camera.timing.drive import packet_times_s
from nir_render.scene.scene import Scene
from nir_render.truth.sent import SentTruth
from perception.messages.uart import meaning, word_of


def sent_packets(scene: Scene) -> Iterator[SentTruth]:
    """Yield the packets of each source, at true times."""
    for name, (_, source) in scene.sources().items():
        if source.drive.sends is None:
            continue
        robot, _, own = name.partition(".")
        for packet, (start_s, end_s) in zip(
            source.drive.sends.packets, packet_times_s(source.drive.sends), strict=True
        ):
            word = word_of(packet.command)
            yield SentTruth(robot, own, start_s, end_s, word, meaning(word))
