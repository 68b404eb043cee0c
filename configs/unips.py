"""The paper's network and recipe, on PS-Wild folders, every value written out.

    unips train --config unips --workdir runs/unips --data.root PS-Wild

Paper: "Universal Photometric Stereo Network using Global Lighting Contexts" (Ikehata,
CVPR 2022); "Supp." is its supplement. A departure from it is marked as such, with the
option that takes it back.
Hardware of the paper: one Quadro RTX 8000, 48 hours. Not trained here: neither that
data set nor that time were at hand. On smaller GPUs --mesh.microbatches 3 takes the
memory of one object at a time.
"""

from unips_jax.models.config import UniPSConfig
from unips_jax.training.config import Config, DataConfig, OptimConfig, TrainConfig

OBJECTS, BATCH, EPOCHS = 10_099, 3, 20  # Sec. 3 (PS-Wild), Supp., Supp.


def get_config() -> Config:
    """The configuration."""
    return Config(model=network(), data=data(), optim=optim(), train=length())


def network() -> UniPSConfig:
    """Sec. 4."""
    return UniPSConfig(
        # The encoder, Sec. 4.1.
        canonical_size=256,  # Sec. 4.1, Table 4 compares 128
        patch_channels=(48, 96),  # Supp.: five convolutions in place of Swin's one
        embed_dim=96,  # Supp.: Swin-S, as the five values below
        depths=(2, 2, 18, 2),
        num_heads=(3, 6, 12, 24),
        window_size=7,
        mlp_ratio=4.0,
        drop_path_rate=0.2,
        communication="pre",  # Sec. 4.1, "pre-fusion" in Table 3
        communication_heads=8,  # Supp.
        communication_mlp_ratio=2.0,  # Supp.
        context_dim=256,  # Supp.: UPerNet's width
        pool_scales=(1, 2, 3, 6),  # Supp.: UPerNet's pyramid pooling
        # The decoder, Sec. 4.2.
        aggregation="pma",  # Sec. 4.2, which compares the maximum ("max")
        aggregation_layers=3,  # Sec. 4.2; the authors' released weights have 4
        hidden_dim=384,  # Supp., as the five values below
        aggregation_heads=8,
        aggregation_mlp_dim=1024,
        pma_mlp_dim=512,
        predictor_dim=192,
        dropout_rate=0.1,
        attention="pre_norm",  # the Transformer's layer; theirs: "released"
        # Departure: the released network reads the contexts half a pixel off.
        context_sampling="center",
        dtype="float32",
        remat=True,  # memory for time, the same function
    )


def data() -> DataConfig:
    """Sec. 3 and 4.3."""
    return DataConfig(
        source="folders",
        image_size=512,  # Sec. 3
        frame="image",  # Sec. 4: the encoder sees the whole image
        batch_size=BATCH,  # Supp.; the authors' code has 4
        num_images=tuple(range(2, 11)),  # Supp.: 2 to 10 of an object's ten
        num_pixels=2500,  # Sec. 4.3: m, drawn at full resolution
        max_tokens=0,
        pixel_blocks=False,
        grid_loss=True,  # Sec. 4.3: and all pixels of the contexts' grid
        augment=True,  # Supp.: flips, transposition, colours permuted
    )


def optim() -> OptimConfig:
    """Supp."""
    return OptimConfig(
        name="adamw",
        learning_rate=1e-4,
        schedule="step",
        warmup_steps=0,
        decay_every=3 * OBJECTS // BATCH,  # three epochs
        decay_rate=0.8,
        weight_decay=0.05,  # the authors' code has 0.01
        b2=0.999,  # AdamW's own
        # Departure: longer gradients are cut. --optim.clip-norm 0: none.
        clip_norm=1.0,
        # Departure: averaged parameters are released. --optim.ema-decay 0: the last.
        ema_decay=0.999,
    )


def length() -> TrainConfig:
    """Supp.; seed and rhythm are ours."""
    return TrainConfig(
        steps=round(EPOCHS * OBJECTS / BATCH),
        seed=0,
        squared_loss=True,  # Sec. 4.3
        steepness_weight=0.0,
        differences_weight=0.0,
        log_every=20,
        checkpoint_every=500,
        keep=2,
        # Departure: the best step is chosen on 64 held-out scenes of ours.
        validate_every=2000,
        validation_scenes=64,
        validation_images=8,
    )
