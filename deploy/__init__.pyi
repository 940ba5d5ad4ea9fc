from .bench.board import predict as predict
from .board import Board as Board
from .board import boards as boards
from .board import networks as networks
from .board import sensors as sensors
from .dpu.checker.table import check as check
from .library import restore as restore
from .network import Network as Network
from .pairs import Pair as Pair
from .pairs import simulate as simulate
from .profiles.errors import BeersError as BeersError
from .profiles.sensor import Sensor as Sensor
from .quant.limits import Limits as Limits
from .quantise import quantize as quantize
from .results import Table as Table
from .studies.characterise import characterize as characterize
from .studies.evaluation.run import evaluate as evaluate
from .studies.tradeoff.run import tradeoff as tradeoff
from .verdict import compare as compare
from .verdict import gate as gate

__version__: str
