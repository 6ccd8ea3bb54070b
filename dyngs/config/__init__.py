"""The configuration of a run: typed keys, YAML files, overrides."""

from dyngs.config.keys import (
    AutoColour as AutoColour,
)
from dyngs.config.keys import (
    BudgetConfig as BudgetConfig,
)
from dyngs.config.keys import (
    ColourSection as ColourSection,
)
from dyngs.config.keys import (
    CompactConfig as CompactConfig,
)
from dyngs.config.keys import (
    Config as Config,
)
from dyngs.config.keys import (
    CutOff as CutOff,
)
from dyngs.config.keys import (
    DataConfig as DataConfig,
)
from dyngs.config.keys import (
    DcacColour as DcacColour,
)
from dyngs.config.keys import (
    DefaultStrategy as DefaultStrategy,
)
from dyngs.config.keys import (
    DeformField as DeformField,
)
from dyngs.config.keys import (
    DynamicModel as DynamicModel,
)
from dyngs.config.keys import (
    FieldSection as FieldSection,
)
from dyngs.config.keys import (
    Fraction as Fraction,
)
from dyngs.config.keys import (
    HexplaneField as HexplaneField,
)
from dyngs.config.keys import (
    HumanModel as HumanModel,
)
from dyngs.config.keys import (
    HumanNetModel as HumanNetModel,
)
from dyngs.config.keys import (
    McmcStrategy as McmcStrategy,
)
from dyngs.config.keys import (
    MlpField as MlpField,
)
from dyngs.config.keys import (
    OptimConfig as OptimConfig,
)
from dyngs.config.keys import (
    PointsInit as PointsInit,
)
from dyngs.config.keys import (
    Positive as Positive,
)
from dyngs.config.keys import (
    RandomInit as RandomInit,
)
from dyngs.config.keys import (
    RunConfig as RunConfig,
)
from dyngs.config.keys import (
    SceneModel as SceneModel,
)
from dyngs.config.keys import (
    Section as Section,
)
from dyngs.config.keys import (
    ShColour as ShColour,
)
from dyngs.config.keys import (
    SkeletonField as SkeletonField,
)
from dyngs.config.keys import (
    StaticModel as StaticModel,
)
from dyngs.config.keys import (
    TrainConfig as TrainConfig,
)
from dyngs.config.keys import (
    TrajectoryField as TrajectoryField,
)
