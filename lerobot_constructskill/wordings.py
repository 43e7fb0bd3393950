"""Other ways to say what a task asks: some to train with, others never, by how far they are from its own sentence."""

_ORDER = "Put the {} into the {} bin."
REWORDINGS = {
    "Pick up the brick and place it in the bin.": (
        ("Take the brick and put it into the bin.", "The brick belongs in the bin: put it there."),
        ("Grasp the brick and set it in the bin.",),
        ("Into the bin with the brick, please.",),
        ("Somebody left a brick out here. Tidy it away into the bin.",),
    ),
    "Pick up the concrete block and place it in the bin.": (
        ("Take the concrete block and put it into the bin.", "The concrete block belongs in the bin: put it there."),
        ("Grasp the concrete block and set it in the bin.",),
        ("Into the bin with the concrete block, please.",),
        ("That block of concrete is in the way. Tidy it away into the bin.",),
    ),
    "Pick up the brick and set it down in the close-fitting bin.": (
        ("Take the brick and lower it into the tight bin.", "The brick fits the bin with little play: put it in."),
        ("Grasp the brick and lay it in the narrow bin.",),
        ("Fit the brick into the bin that hardly leaves it room.",),
        ("There is a snug bin for this brick. See that it ends up in there.",),
    ),
    "Turn the gripper to the brick, pick it up and place it in the bin.": (
        (
            "Align the gripper with the brick, take it and put it into the bin.",
            "Turn to the brick, and bring it to the bin.",
        ),
        ("Rotate the gripper to the brick, grasp it and set it in the bin.",),
        ("The brick lies askew: turn the jaws to it before you put it into the bin.",),
        ("Mind how that brick is lying when you tidy it away into the bin.",),
    ),
    "Pick up the brick and set it flush on top of the other brick.": (
        ("Take the brick and lay it flush on the other brick.", "Stack the brick on the other one, edge on edge."),
        ("Grasp the brick and place it flush on the second brick.",),
        ("The two bricks are to stand one on the other, with their faces in line.",),
        ("Start the next course: one brick goes right on this one.",),
    ),
    "Take the ceiling tile by its lifter and lay it into the opening of the grid.": (
        (
            "Pick up the ceiling tile by the lifter and put it into the grid's opening.",
            "Close the grid with the ceiling tile.",
        ),
        ("Grasp the ceiling tile by its lifter and set it into the gap of the grid.",),
        ("The opening in the grid is for the tile: lower the tile into it.",),
        ("The ceiling is missing its last tile. Put it in.",),
    ),
    "Pick up the timber post and set its tenon into the mortise of the sill.": (
        (
            "Take the timber post and put its tenon into the sill's mortise.",
            "Stand the post in the sill, tenon in mortise.",
        ),
        ("Grasp the wooden post and place its tenon in the mortise of the sill.",),
        ("The sill has a mortise for the post's tenon: join them.",),
        ("Get that timber standing where the sill was cut for it.",),
    ),
    "Lay the three bricks end to end, with joints of ten millimetres.": (
        ("Place three bricks in a row and leave ten millimetres between them.", "Build a course of three bricks."),
        ("Set the three bricks end to end, with gaps of a centimetre.",),
        ("Between one brick and the next stay ten millimetres; there are three in the row.",),
        ("One course, three long, usual joints.",),
    ),
    "Lay three bricks end to end and the other two on their joints.": (
        (
            "Place three bricks in a row and two more on the gaps between them.",
            "Build a running bond of three and two bricks.",
        ),
        ("Set three bricks end to end and the remaining two on their joints.",),
        ("Two bricks cover the joints of the three below.",),
        ("Two courses in stretcher bond, three and two.",),
    ),
    "Set up the two posts and lay the beam across them.": (
        ("Stand the two posts up and put the beam on them.", "Build a frame: two posts and a beam on top."),
        ("Erect both posts and place the beam across them.",),
        ("The beam rests on two posts, which come first.",),
        ("Give me a lintel on its two supports.",),
    ),
    "Build the wall after its plan.": (
        ("Lay the elements as the plan says.", "Build what the plan shows."),
        ("Construct the wall according to the plan.",),
        ("The plan says where each element goes: put them there.",),
        ("Here is the drawing. Get going.",),
    ),
} | {
    _ORDER.format(item, colour): (
        (f"Place the {item} in the {colour} bin.", f"The {item} goes into the {colour} bin."),
        (f"Drop the {item} in the {colour} container.",),
        (f"Of the two bins, the {colour} one is for the {item}.",),
        (f"I need the {item} out of the way. Use the {colour} bin.",),
    )
    for item in ("brick", "block")
    for colour in ("grey", "blue")
}
"""Of each instruction, what means the same. First sentences to train with, then those that are never trained with, by
level of the axis `language`: other words in the same sentence, another sentence, one as a colleague would say it."""
