from .kit.board import Board as Board
from .network import Network as Network
from .pairs import Pair as Pair
from .profiles.errors import BeersError as BeersError
from .profiles.sensor import Sensor as Sensor
from .quant.limits import Limits as Limits
from .results import Table as Table
from .shipped_tables import boards as boards
from .shipped_tables import networks as networks
from .shipped_tables import sensors as sensors
from .verbs.bench import bench as bench
from .verbs.characterize import characterize as characterize
from .verbs.check import check as check
from .verbs.compare import compare as compare
from .verbs.demo import demo as demo
from .verbs.evaluate import evaluate as evaluate
from .verbs.export import export as export
from .verbs.gate import gate as gate
from .verbs.golden import golden as golden
from .verbs.quantize import quantize as quantize
from .verbs.restore import restore as restore
from .verbs.simulate import simulate as simulate
from .verbs.stress import stress as stress
from .verbs.tradeoff import tradeoff as tradeoff
from .verbs.train import train as train

__version__: str
