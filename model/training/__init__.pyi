from .checkpoint import TrainingRecipe as TrainingRecipe
from .losses import RestorationLoss as RestorationLoss
from .patches import PatchRecipe as PatchRecipe
from .run import Run as Run
from .run import train as train
