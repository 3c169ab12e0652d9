"""Taxonomy of common nouns.

Lookup tables store embeddings of these nouns, so that searching them needs no encoder, and are calibrated with them,
because any scene contains few of them. Format: one line per kind, ``kind < broader kind: members``; "_" joins the parts
of a word.
"""

from __future__ import annotations

import functools

import numpy as np

from ..search import english

_KINDS = """\
food: bread cheese egg rice pasta soup sandwich pizza hamburger sausage meat steak chicken salad honey butter sushi \
noodle
fruit < food: apple banana orange lemon lime pear peach plum cherry grape strawberry raspberry blueberry melon \
watermelon pineapple mango kiwi coconut apricot fig grapefruit
citrus < fruit: orange lemon lime grapefruit tangerine
berry < fruit: strawberry raspberry blueberry blackberry
vegetable < food: carrot potato tomato onion garlic cucumber pepper cabbage lettuce broccoli cauliflower pumpkin \
corn pea bean mushroom spinach eggplant radish leek
pastry < food: donut croissant pie muffin tart pretzel bagel danish eclair
dessert < food: cake donut pie pudding ice_cream cookie brownie waffle pancake cupcake
sweet < food: candy chocolate lollipop caramel marshmallow
drink: coffee tea milk juice beer wine lemonade water soda
animal: snail turtle frog lizard crocodile
mammal < animal: elephant lion tiger bear wolf fox rabbit squirrel mouse rat monkey giraffe zebra hippopotamus \
rhinoceros camel kangaroo deer hedgehog bat panda
pet < animal: dog cat hamster goldfish parrot rabbit
farm_animal < animal: cow horse pig sheep goat donkey chicken duck goose
bird < animal: eagle owl parrot penguin duck goose swan pigeon crow sparrow ostrich flamingo
fish < animal: shark salmon trout tuna goldfish eel
insect < animal: bee ant butterfly beetle fly mosquito dragonfly ladybug grasshopper
reptile < animal: snake lizard turtle crocodile
dinosaur < animal: tyrannosaurus stegosaurus triceratops
vehicle: tractor bulldozer wagon cart trolley sled
car < vehicle: taxi limousine convertible racing_car police_car
truck < vehicle: fire_truck pickup dump_truck van
two-wheeler < vehicle: bicycle motorcycle scooter
aircraft < vehicle: airplane helicopter glider jet drone airship
boat < vehicle: ship canoe kayak sailboat ferry submarine raft yacht
train < vehicle: locomotive tram subway
furniture: shelf bookcase dresser bed mattress crib
seat < furniture: chair sofa armchair stool bench throne rocking_chair
table < furniture: desk coffee_table workbench dining_table
cupboard < furniture: wardrobe cabinet
bedding: pillow blanket sheet quilt
tool: axe saw drill screwdriver hammer wrench pliers shovel rake chisel file crowbar hoe
fastener: nail screw bolt nut rivet
kitchenware: pot pan kettle whisk rolling_pin grater sieve cutting_board
cutlery < kitchenware: fork spoon knife chopsticks
crockery < kitchenware: plate bowl mug cup saucer teapot
cookware < kitchenware: pot pan wok saucepan
container: box crate barrel bucket basket jar can tin chest bin
vessel < container: jug pitcher bottle flask vase
drinking_vessel < container: mug cup wine_glass goblet tumbler
bag < container: backpack suitcase handbag sack briefcase
appliance: refrigerator oven microwave toaster blender dishwasher washing_machine vacuum_cleaner iron fan
electronic_device: computer laptop tablet phone television radio speaker camera printer keyboard monitor headphones \
microphone
musical_instrument: drum harp xylophone accordion harmonica bell
string_instrument < musical_instrument: guitar violin cello harp banjo
wind_instrument < musical_instrument: trumpet flute saxophone clarinet trombone tuba
keyboard_instrument < musical_instrument: piano organ accordion
toy: doll teddy_bear kite puzzle yo-yo spinning_top rattle toy_car
game: chess dice dominoes playing_cards
chess_piece < game: king queen rook bishop knight pawn
sports_equipment: bat racket helmet skateboard surfboard ski dumbbell net
ball < sports_equipment: football basketball tennis_ball golf_ball volleyball
clothing: coat jacket dress skirt sweater scarf glove sock belt tie
trousers < clothing: jeans shorts
footwear < clothing: shoe boot sandal slipper sneaker
headwear < clothing: hat cap helmet crown beret
jewellery: ring necklace bracelet earring brooch crown
weapon: sword gun bow spear dagger rifle cannon shield
building: house church castle tower barn skyscraper hut factory garage windmill temple
room: kitchen bedroom bathroom office
part_of_a_building: door window roof wall floor ceiling stairs chimney balcony column
plant: tree bush cactus fern grass moss ivy bamboo
flower < plant: rose tulip daisy sunflower lily orchid
tree < plant: oak pine palm birch willow
body_part: hand foot arm leg head eye nose ear mouth finger
person: man woman child baby soldier doctor cook dancer
stationery: pen pencil eraser ruler scissors stapler notebook envelope paper_clip
reading_matter: book magazine newspaper map letter
light: lamp candle lantern flashlight chandelier torch
timepiece: clock watch hourglass alarm_clock
instrument_of_measurement: thermometer scale ruler compass barometer
optical_instrument: microscope telescope binoculars magnifying_glass
machine: engine motor pump crane conveyor_belt lathe press turbine generator robot
machine_part: gear wheel axle spring chain lever pulley belt piston pinion shaft
cleaning_tool: broom mop sponge brush bucket
toiletry: soap towel toothbrush comb razor shampoo
bathroom_fixture: toilet bathtub sink shower mirror
medicine: pill syringe bandage thermometer
decoration: painting statue vase ribbon balloon flag wreath picture_frame globe
material: wood metal stone glass plastic paper cloth leather rubber clay
stone < material: marble granite diamond brick
natural_feature: mountain river lake beach island volcano waterfall forest cave
sky_object: sun moon star cloud rainbow
money: coin banknote credit_card
sign: traffic_light street_sign poster
street_furniture: lamp_post fire_hydrant mailbox trash_can
"""


@functools.cache
def broader() -> dict[str, frozenset[str]]:
    """Map each noun to all its hypernyms: "lemon" -> {"citrus", "fruit", "food"}."""
    kinds, parents = [], {}
    for line in _KINDS.strip().splitlines():
        head, members = line.split(":")
        kind, *parent = (part.strip().replace("_", " ") for part in head.split("<"))
        kinds.append((kind, [word.replace("_", " ") for word in members.split()]))
        parents[kind] = parent[0] if parent else None
    result: dict[str, set[str]] = {}
    for kind, members in kinds:
        above, step = set(), parents[kind]
        while step is not None:
            above.add(step)
            step = parents[step]
        result.setdefault(kind, set()).update(above)
        for word in members:
            result.setdefault(word, set()).update({kind, *above})
    return {word: frozenset(above) for word, above in sorted(result.items())}


def words() -> tuple[str, ...]:
    """All nouns, including kinds, in alphabetical order."""
    return tuple(broader())


def things() -> tuple[str, ...]:
    """Nouns without hyponyms: no other noun is a kind of them."""
    kinds = {kind for above in broader().values() for kind in above}
    return tuple(word for word in words() if word not in kinds)


@functools.cache
def relations() -> np.ndarray:
    """Mask of the pairs of `words` that are equal, kind and member, or members of one kind. [W, W] bool"""
    rows = {word: row for row, word in enumerate(words())}
    above = np.eye(len(rows), dtype=np.float32)
    for word, kinds in broader().items():
        above[rows[word], [rows[kind] for kind in kinds]] = 1
    return above @ above.T > 0


def known(phrase: str) -> str | None:
    """Return the noun of a phrase: the phrase or its last words, e.g. "crate" for "blue crate"; None if unknown."""
    nouns = _by_words()
    said = english.words_of(phrase)
    return next((nouns[tuple(said[k:])] for k in range(len(said)) if tuple(said[k:]) in nouns), None)


@functools.cache
def _by_words() -> dict[tuple[str, ...], str]:
    return {tuple(english.words_of(word)): word for word in words()}
