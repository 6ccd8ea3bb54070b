"""Variants say what they change; settings refuse what they cannot be."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dyngs.core.errors import DyngsError
from dyngs.study.variants import (
    Variant,
    parse_variations,
    single_changes,
)

VARIANTS = st.builds(
    Variant,
    colour=st.sampled_from([None, "network"]),
    prune=st.sampled_from([0.0, 0.5, 0.7]),
    mask_times=st.sampled_from([0, 6]),
    sh_degree=st.sampled_from([None, 0, 1]),
    storage=st.sampled_from([None, "auto", 1.0]),
    mode=st.sampled_from([None, "antialiased"]),
    alpha_min=st.sampled_from([None, 0.01]),
    scale=st.sampled_from([1.0, 0.5]),
    field=st.sampled_from([None, "mlp"]),
    field_size=st.sampled_from([1.0, 0.5]),
    field_step=st.sampled_from([1.0, 4.0]),
    supersampling=st.sampled_from([None, 1]),
    triangles=st.sampled_from([1.0, 0.5]),
)
DYNAMIC = {
    "prune": 0.0,
    "sh_degree": 2,
    "storage": None,
    "mode": "classic",
    "alpha_min": 1 / 255,
    "transmittance_min": 1e-4,
    "scale": 1.0,
    "mask_times": 0,
    "colour": "sh",
    "field": "control_nodes",
    "field_size": 1.0,
    "field_step": 1.0,
}


@given(VARIANTS)
def test_a_variant_survives_its_file(variant: Variant) -> None:
    assert Variant(**json.loads(json.dumps(variant.changes))) == variant


@given(VARIANTS, VARIANTS)
def test_names_of_files_tell_variants_apart(a: Variant, b: Variant) -> None:
    assert (a.slug == b.slug) == (a == b)
    assert "/" not in a.slug
    assert " " not in a.slug


@given(VARIANTS, VARIANTS)
def test_merging_keeps_what_the_other_changes(a: Variant, b: Variant) -> None:
    merged = a.merged(b)
    assert merged.changes == a.changes | b.changes
    assert merged.merged(b) == merged
    assert Variant().merged(a) == a


def test_what_lies_on_disk_does_not_depend_on_drawing() -> None:
    drawn = Variant(
        mode="antialiased", alpha_min=0.01, transmittance_min=0.01, scale=0.5, supersampling=1
    )
    assert drawn.stored == Variant()
    assert replace(drawn, prune=0.5).stored == Variant(prune=0.5)
    assert replace(drawn, colour="sh", field="mlp", prune=0.5).trained == Variant(
        colour="sh", field="mlp"
    )


def test_the_setting_of_a_variant() -> None:
    assert Variant().setting == ""
    assert Variant().name == "as it is"
    assert Variant(prune=0.5).setting == "prune"
    assert Variant(prune=0.5, finetune=9).setting == "prune + finetune"
    assert Variant(storage="auto", field_step=4.0).setting == "storage + field_step"
    assert Variant(prune=0.5, sh_degree=0).setting == "several"
    assert Variant(sh_degree=0).name == "sh_degree=0"


def test_single_changes_leave_out_what_a_run_is_already() -> None:
    names = [v.name for v in single_changes(parse_variations([], trains=True), DYNAMIC, 0)]
    assert len(names) == len(set(names))
    assert {
        "sh_degree=0",
        "sh_degree=1",
        "mask_times=6",
        "mode=antialiased",
        "colour=network",
        "field=mlp",
    } <= set(names)
    assert not {"sh_degree=2", "mode=classic", "colour=sh", "field=control_nodes"} & set(names)
    still = {"sh_degree": 0, "storage": None, "scale": 1.0}
    fewer = [v.name for v in single_changes(parse_variations([], trains=True), still, 0)]
    assert fewer == ["storage=auto", "storage=1", "storage=3", "scale=0.75", "scale=0.5"]


def test_own_values_are_the_start() -> None:
    variations = parse_variations(["alpha_min=0.008,0.016"], trains=False)
    assert single_changes(variations, DYNAMIC | {"alpha_min": 0.008}, 0) == [
        Variant(alpha_min=0.016)
    ]
    variations = parse_variations(["mask_times=6,16"], trains=False)
    assert single_changes(variations, DYNAMIC | {"mask_times": 6}, 0) == [Variant(mask_times=16)]


def test_steps_of_the_field_are_those_of_storage() -> None:
    variations = parse_variations(["field_step=4"], trains=False)
    assert single_changes(variations, DYNAMIC, 0) == [Variant(storage="auto", field_step=4.0)]


def test_fine_tuning_comes_in_addition() -> None:
    found = single_changes(parse_variations(["prune=0.5", "scale=0.5"], trains=False), DYNAMIC, 7)
    assert found == [Variant(prune=0.5), Variant(prune=0.5, finetune=7), Variant(scale=0.5)]


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("prun", "no such setting; there are prune, mask_times, sh_degree"),
        ("prune=1.5", "--vary prune=1.5: give a number from 0.01 to 0.99"),
        ("prune=", "give a number"),
        ("prune=nan", "give a number"),
        ("mask_times=2.5", "give a whole number from 2 to 1000"),
        ("storage=fine", "give a number from 0.01 to 64 or auto"),
        ("mode=smooth", "give classic or antialiased"),
        ("colour", "add --train"),
    ],
)
def test_what_cannot_be_varied_is_refused(word: str, message: str) -> None:
    with pytest.raises(DyngsError, match=message):
        parse_variations([word], trains=False)


def test_a_setting_twice_is_refused() -> None:
    with pytest.raises(DyngsError, match="twice"):
        parse_variations(["scale=0.5", "scale=0.7"], trains=False)
