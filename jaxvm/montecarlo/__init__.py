"""Monte Carlo studies: many trials of any estimator, on all devices, written and resumed."""

from jaxvm.montecarlo.estimators import ESTIMATORS as ESTIMATORS
from jaxvm.montecarlo.estimators import GaussNewton as GaussNewton
from jaxvm.montecarlo.estimators import LevenbergMarquardt as LevenbergMarquardt
from jaxvm.montecarlo.estimators import Spgd as Spgd
from jaxvm.montecarlo.networks import MonteCarlo as MonteCarlo
from jaxvm.montecarlo.networks import Spread as Spread
from jaxvm.montecarlo.networks import montecarlo as montecarlo
from jaxvm.montecarlo.networks import network_study as network_study
from jaxvm.montecarlo.networks import station_trials as station_trials
from jaxvm.montecarlo.poses import pose_study as pose_study
from jaxvm.montecarlo.results import Results as Results
from jaxvm.montecarlo.run import Progress as Progress
from jaxvm.montecarlo.run import run as run
from jaxvm.montecarlo.statistics import Statistics as Statistics
from jaxvm.montecarlo.trials import OneByOne as OneByOne
from jaxvm.montecarlo.trials import Together as Together
from jaxvm.montecarlo.trials import Traced as Traced
from jaxvm.montecarlo.trials import Trial as Trial
