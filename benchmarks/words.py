"""Quality of finding objects by words, from their names.

    python -m benchmarks.words --encoder DIR|text [--json FILE]

Tables of names without captions are queried with other words for their objects, and with words for missing things. The
prompts were written before any threshold was chosen; only the margin between matches was chosen with them. Columns:

    top1     prompts whose best match is right
    all      prompts whose matches are exactly the right ones
    hits     right objects found, of all ``right`` ones and of all ``found`` ones
    nothing  prompts for missing things that match nothing

Results: docs/results/words.md.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from r5dgs_core.language import build_table, query
from r5dgs_core.language.encoders import encoder_base, registry
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.scene.scene import Gaussians, MotionGroup, Scene, SceneObject, Tracks

NAMES = {
    "kitchen": ("mug", "lemon", "apple", "donut", "cutting board", "bowl"),
    "chessboard": (
        "white king", "black queen", "white rook", "black rook", "white knight", "black bishop", "black pawn",
        "white pawn",
    ),
    "darkroom": (
        "film reel", "canister", "tray", "film strip", "cabinet door", "film can", "trolley", "developing tank",
    ),
    "dining": ("lamp", "chair", "stool", "plate", "orange", "teapot", "ball", "pepper mill"),
    "factory": (
        "red crate", "blue crate", "drum", "robot arm", "crane load", "gear", "pinion", "barrel", "cart", "press ram",
        "toolbox",
    ),
    "nonrigid": ("flag", "balloon", "toy car", "wooden block", "vase"),
    "toys": (
        "lemon", "apple", "donut", "mug", "fork", "table", "sofa", "lamp", "wall", "floor", "rook", "knight", "book",
        "ball", "car",
    ),
}  # fmt: skip
PRESENT = {
    "kitchen": {
        "fruit": ("lemon", "apple"), "pastry": ("donut",), "citrus": ("lemon",), "doughnut": ("donut",),
        "cup": ("mug",), "dish": ("bowl",), "crockery": ("mug", "bowl"), "something sour": ("lemon",),
        "food": ("lemon", "apple", "donut"),
    },
    "chessboard": {
        "castle": ("white rook", "black rook"), "horse": ("white knight",), "monarch": ("white king", "black queen"),
    },
    "darkroom": {
        "movie reel": ("film reel",), "cupboard": ("cabinet door",), "wagon": ("trolley",),
        "container": ("canister", "film can", "developing tank"),
    },
    "dining": {
        "furniture": ("chair", "stool"), "seat": ("chair", "stool"), "fruit": ("orange",), "kettle": ("teapot",),
        "light": ("lamp",), "crockery": ("plate", "teapot"), "toy": ("ball",), "spice grinder": ("pepper mill",),
    },
    "factory": {
        "box": ("red crate", "blue crate", "toolbox"), "cogwheel": ("gear", "pinion"), "keg": ("barrel",),
        "vehicle": ("cart",), "manipulator": ("robot arm",), "container": ("red crate", "blue crate", "drum", "barrel"),
    },
    "nonrigid": {
        "banner": ("flag",), "vehicle": ("toy car",), "automobile": ("toy car",), "jar": ("vase",),
        "piece of wood": ("wooden block",),
    },
    "toys": {
        "fruit": ("lemon", "apple"), "pastry": ("donut",), "cutlery": ("fork",), "furniture": ("sofa", "table"),
        "citrus": ("lemon",), "couch": ("sofa",), "board game piece": ("rook", "knight"), "vehicle": ("car",),
        "light": ("lamp",), "something to read": ("book",),
    },
}  # fmt: skip
ABSENT = (
    "elephant", "aeroplane", "dinosaur", "bicycle", "piano", "shoe", "tree", "dog", "computer", "guitar", "bed",
    "umbrella", "hammer", "shark", "cloud", "person", "tiger", "sword", "telephone", "boat", "sandwich", "window",
)  # fmt: skip


class Remembering:
    """Encoder that embeds each text once, because the tables share most of their texts."""

    def __init__(self, encoder: encoder_base.Encoder):
        self.card = encoder.card
        self.embed_images = encoder.embed_images
        self._encoder = encoder
        self._known: dict[str, np.ndarray] = {}

    def embed_texts(self, texts: Sequence[str]) -> np.ndarray:
        """As `encoder_base.Encoder`."""
        fresh = [text for text in dict.fromkeys(texts) if text not in self._known]
        self._known |= dict(zip(fresh, self._encoder.embed_texts(fresh), strict=True))
        return np.stack([self._known[text] for text in texts])


def named(names: tuple[str, ...]) -> Scene:
    """Scene with one Gaussian per name, which is all that a search needs."""
    count = len(names)
    objects = (
        SceneObject(0, "background", (), "", (0.5, 0.5, 0.5), 0, 0),
        *(SceneObject(k + 1, name, (), "", (0.5, 0.5, 0.5), k, 1) for k, name in enumerate(names)),
    )
    pinned = MotionGroup(0, 0, "pinned", -1, np.zeros(3), MotionModel())
    return Scene(
        name="names",
        gaussians=Gaussians(
            means=np.zeros((count, 3), np.float32),
            quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
            log_scales=np.zeros((count, 3), np.float32),
            opacity_logits=np.zeros(count, np.float32),
            sh=np.zeros((count, 1, 3), np.float32),
            object_ids=np.arange(1, count + 1, dtype=np.int32),
            motion_ids=np.zeros(count, np.int32),
        ),
        tracks=Tracks(np.zeros(1), np.array([[[1.0, 0, 0, 0, 0, 0, 0]]])),
        objects=objects,
        groups=(pinned,),
        t_max=0.0,
        frames_per_unit=60.0,
        world_convention="blender",
        cameras=(),
        background_sh=np.zeros((1, 3), np.float32),
    )


def measure(name: str, encoder: encoder_base.Encoder) -> dict[str, Any]:
    """Return a row: counts, and the wrong answers."""
    scene = build_table.make(named(NAMES[name]), encoder).scene
    called = {item.id: item.name for item in scene.objects}
    row: dict[str, Any] = {"table": name, "present": 0, "top1": 0, "all": 0, "wrong": []}
    row |= dict.fromkeys(("hits", "right", "found", "absent", "nothing"), 0)
    for prompt, right in PRESENT[name].items():
        found = [called[match.object_id] for match in query.find(scene, prompt, encoder)]
        row["present"] += 1
        row["top1"] += bool(found) and found[0] in right
        row["all"] += set(found) == set(right)
        row["hits"] += len(set(found) & set(right))
        row["right"] += len(right)
        row["found"] += len(found)
        if set(found) != set(right):
            row["wrong"].append(f"{prompt}: {', '.join(found) or 'nothing'} instead of {', '.join(right)}")
    for prompt in ABSENT:
        found = [called[match.object_id] for match in query.find(scene, prompt, encoder)]
        row["absent"] += 1
        row["nothing"] += not found
        if found:
            row["wrong"].append(f"{prompt}: {', '.join(found)} instead of nothing")
    return row


def main() -> None:
    """Measure all tables and print them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--encoder", default="text", help="folder, or text")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    args = parser.parse_args()
    encoder = Remembering(registry.open_encoder(args.encoder))
    rows = [measure(name, encoder) for name in NAMES]
    total: dict[str, Any] = {key: sum(row[key] for row in rows) for key in rows[0] if isinstance(rows[0][key], int)}
    print(
        "| table | top-1 | exactly the right ones | right ones found | of what was found | nothing for absent things |"
    )
    print("|---|---|---|---|---|---|")
    for row in (*rows, {"table": "**all**", **total}):
        counts = (("top1", "present"), ("all", "present"), ("hits", "right"), ("hits", "found"), ("nothing", "absent"))
        print(f"| {row['table']} | {' | '.join(f'{row[a]}/{row[b]}' for a, b in counts)} |")
    for row in rows:
        for line in row["wrong"]:
            print(f"{row['table']}: {line}")
    if args.json:
        args.json.write_text(json.dumps({"encoder": encoder.card.name, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
