"""The methods that can be evaluated: UniPS, the baselines, and anyone's.

A method is asked for as `name` or `name:option=value,option=value`, such as
`least-squares:keep=(0.2,0.8)`. GCNet takes PS-FCN's weights, or the name of a
calibrated baseline, for the normals: `gcnet:weights=GCNET,normals=PS_FCN`. Of any
method `sign=oracle` takes the signs of x, y and z that the truth likes best, as
publications do where convex and concave look the same; a dagger marks its results.
`files:DIR` are normals that another program made (`normal_files`),
`python:module:factory` a method in a module of the user's (`foreign`). Modules are
imported when a method of theirs is asked for.
"""

import dataclasses
import importlib
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from unips_jax.baselines.method import Method, Observed
from unips_jax.errors import InputError
from unips_jax.evaluation.foreign import from_module, from_package, installed
from unips_jax.evaluation.normal_files import from_files
from unips_jax.evaluation.registry import BASELINES, CLASSICAL, NAMES
from unips_jax.evaluation.variants import (
    Variant,
    check_types,
    described,
    hashed,
    label_of,
    parse_options,
    take_oracle,
)
