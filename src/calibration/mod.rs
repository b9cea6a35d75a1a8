//! Calibration on the adapter at hand: times of the training step, stage by stage, beside the floor that the adapter's own
//! bandwidth and arithmetic set for the work really done.

mod host;
mod lanes;
mod rates;
mod scene;
mod step;
mod work;

pub use host::{HostBench, HostReport, bench_host};
pub use lanes::{LaneUse, Lanes};
pub use rates::{Rates, measure_rates};
pub use scene::BenchScene;
pub use step::{StageReport, StepBench, StepReport, StepRunner, StepTimes, bench_step};
pub use work::{Work, count_work};
