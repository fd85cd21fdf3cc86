"""Statistics of the protocol against published values, other programs and their definitions."""

import dataclasses

import numpy as np
import pytest
import scipy.stats
from experiment_records import result
from lab import tables
from lab.scenes import SceneAt
from lab.statistics import bootstrap, compare, differences, holm, sign_flip


def at(scene, label, psnr, seed=0, views="ab"):
    found = result(label, psnr, seed, per_view={view: [psnr + ord(view), 0.5, 0.1] for view in views})
    cell = dataclasses.replace(found.run.cell, scene=SceneAt(scene, scene))
    return tables.Result(dataclasses.replace(found.run, cell=cell), found.record)


def test_views_seeds_and_scenes_are_averaged_in_this_order():
    results = [at("x", "own", 22.0), at("x", "other", 20.0), at("x", "own", 21.0, 1), at("x", "other", 20.0, 1)]
    results += [at("y", "own", 25.0), at("y", "other", 26.0), at("z", "own", 20.0)]
    found = compare(differences(results, "own", "other", "psnr"))
    assert found.by_scene == {"x": 1.5, "y": -1.0} and found.over_scenes.mean == 0.25 and found.num_won == 1
    assert not found.is_decided and found.p_value == 1.0
    with pytest.raises(ValueError, match="different views of x"):
        differences([at("x", "own", 22.0, views="ac"), at("x", "other", 20.0)], "own", "other", "psnr")


def test_a_mean_without_views_counts_as_one_view():
    results = [at("x", "own", 22.0), at("x", "other", 20.0), at("y", "own", 25.0), at("y", "other", 26.0)]
    old = [tables.Result(one.run, {**one.record, "per_view": None, "psnr": one.record["psnr"]}) for one in results]
    wanted, found = (compare(differences(each, "own", "other", "psnr")) for each in (results, old))
    assert found == wanted and found.by_scene == {"x": 2.0, "y": -1.0}


def test_the_sign_flip_test_is_scipys_exact_permutation_test():
    values = np.random.default_rng(0).normal(0.4, 1.0, 9)
    options = {"permutation_type": "samples", "n_resamples": np.inf}
    wanted = scipy.stats.permutation_test(
        (values, np.zeros(9)), lambda a, b, axis: np.mean(a - b, axis=axis), **options
    )
    assert sign_flip(values) == pytest.approx(wanted.pvalue)
    assert sign_flip(np.arange(1.0, 9.0)) == 2 / 256, "only both extremes"
    assert sign_flip(np.arange(1.0, 23.0)) == 2 / 2**22, "of many scenes without a table of all signs"


def test_the_interval_is_that_of_students_t():
    """3.182 standard errors of four values, as tables of t say."""
    found = compare({str(value): [np.array([value])] for value in (1.0, 2.0, 3.0, 6.0)})
    assert found.over_scenes.half_width == pytest.approx(3.18245 * np.sqrt(14 / 3 / 4), rel=1e-5)


def test_the_bootstrap_of_one_view_a_scene_is_that_of_scenes():
    values = np.random.default_rng(1).normal(size=12)
    low, high = bootstrap({str(index): [np.array([value])] for index, value in enumerate(values)})
    wanted = scipy.stats.bootstrap((values,), np.mean, method="percentile", n_resamples=50_000, rng=0)
    assert (low, high) == pytest.approx(tuple(wanted.confidence_interval), abs=0.02)


def test_the_bootstrap_has_the_variance_of_all_three_levels():
    rng = np.random.default_rng(2)
    found = {str(scene): [rng.normal(size=3) for _ in range(2)] for scene in range(40)}
    low, high = bootstrap(found)
    means = np.array([np.mean(pairs) for pairs in found.values()])
    of_scenes = means.var()
    of_pairs = np.mean([np.var([pair.mean() for pair in pairs]) / 2 for pairs in found.values()])
    of_views = np.mean([np.mean([pair.var() / 3 for pair in pairs]) / 2 for pairs in found.values()])
    wanted = 2 * 1.96 * np.sqrt((of_scenes + of_pairs + of_views) / 40)
    assert high - low == pytest.approx(wanted, rel=0.05)


def test_holms_correction_is_the_published_example():
    """Four p-values; 0.01·4, 0.02·3, 0.03·2 and 0.04, none below the one before it."""
    assert holm({"a": 0.04, "b": 0.01, "c": 0.03, "d": 0.02}) == pytest.approx(
        {"a": 0.06, "b": 0.04, "c": 0.06, "d": 0.06}
    )
