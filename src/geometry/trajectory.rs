//! Stamped trajectories and their TUM text form: `timestamp tx ty tz qx qy qz qw`, camera to world, one pose a line.

use std::io::Write;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use super::Se3;

/// A camera pose with its time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StampedPose {
    /// Seconds, by the clock of the recording.
    pub timestamp_s: f64,
    /// Camera pose in the world, metres.
    pub world_from_camera: Se3,
}

/// Poses in the order of their timestamps.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trajectory {
    /// Poses, strictly ascending in time.
    pub poses: Vec<StampedPose>,
}

/// A trajectory file that cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum TrajectoryError {
    /// The file cannot be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The file cannot be written.
    #[error("cannot write {path}: {source}")]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A line is not eight finite numbers.
    #[error("{path}:{line}: {what}; expected `timestamp tx ty tz qx qy qz qw` in finite numbers")]
    Syntax {
        /// The file or folder.
        path: PathBuf,
        /// Line in the file, from 1.
        line: usize,
        /// What is wrong.
        what: String,
    },
    /// Timestamps do not ascend.
    #[error(
        "{path}:{line}: the timestamp {timestamp_s} is not after the one before it; sort the file by time and drop duplicates"
    )]
    Unsorted {
        /// The file or folder.
        path: PathBuf,
        /// Line in the file, from 1.
        line: usize,
        /// Seconds, by the clock of the recording.
        timestamp_s: f64,
    },
}

impl Trajectory {
    /// Reads a TUM trajectory file.
    ///
    /// # Errors
    /// [`TrajectoryError`] if the file cannot be read, a line is no pose, or timestamps do not ascend.
    pub fn read_tum(path: &Path) -> Result<Self, TrajectoryError> {
        let text = std::fs::read_to_string(path).map_err(|source| TrajectoryError::Read { path: path.into(), source })?;
        Self::parse_tum(&text, path)
    }

    /// Parses a TUM trajectory; `path` is named in errors.
    ///
    /// # Errors
    /// [`TrajectoryError::Syntax`] or [`TrajectoryError::Unsorted`] with the line.
    pub fn parse_tum(text: &str, path: &Path) -> Result<Self, TrajectoryError> {
        let mut poses: Vec<StampedPose> = Vec::new();
        for (index, raw) in text.lines().enumerate() {
            let line = index + 1;
            let content = raw.split('#').next().unwrap_or_default().trim();
            if content.is_empty() {
                continue;
            }
            let syntax = |what: String| TrajectoryError::Syntax { path: path.into(), line, what };
            let mut v = [0.0f64; 8];
            let mut fields = content.split_whitespace();
            for slot in &mut v {
                let field = fields.next().ok_or_else(|| syntax("fewer than 8 numbers".into()))?;
                *slot = field.parse().map_err(|_| syntax(format!("`{field}` is not a number")))?;
                if !slot.is_finite() {
                    return Err(syntax(format!("`{field}` is not finite")));
                }
            }
            if fields.next().is_some() {
                return Err(syntax("more than 8 numbers".into()));
            }
            let quaternion = Quaternion::new(v[7], v[4], v[5], v[6]);
            if quaternion.norm_squared() < 1e-8 {
                return Err(syntax("the quaternion has no length".into()));
            }
            if poses.last().is_some_and(|last| v[0] <= last.timestamp_s) {
                return Err(TrajectoryError::Unsorted { path: path.into(), line, timestamp_s: v[0] });
            }
            let world_from_camera =
                Isometry3::from_parts(Translation3::new(v[1], v[2], v[3]), UnitQuaternion::from_quaternion(quaternion));
            poses.push(StampedPose { timestamp_s: v[0], world_from_camera });
        }
        Ok(Self { poses })
    }

    /// The index of the pose nearest to a time, if within `max_difference_s`; of two equally near ones the earlier.
    pub fn nearest(&self, timestamp_s: f64, max_difference_s: f64) -> Option<usize> {
        let after = self.poses.partition_point(|pose| pose.timestamp_s <= timestamp_s);
        let distance = |i: usize| (self.poses[i].timestamp_s - timestamp_s).abs();
        let candidates = [after.checked_sub(1), (after < self.poses.len()).then_some(after)];
        // `min_by` keeps the first of equals: the earlier.
        let best = candidates.into_iter().flatten().min_by(|&a, &b| distance(a).total_cmp(&distance(b)))?;
        (distance(best) <= max_difference_s).then_some(best)
    }

    /// The TUM text of this trajectory. Nine decimals: far below any tracker's noise, and enough that a reader computes the
    /// same errors as we do.
    pub fn to_tum(&self) -> String {
        let mut text = String::with_capacity(self.poses.len() * 110);
        for pose in &self.poses {
            let t = pose.world_from_camera.translation.vector;
            let q = pose.world_from_camera.rotation.quaternion();
            text.push_str(&format!(
                "{:.6} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9}\n",
                pose.timestamp_s, t.x, t.y, t.z, q.i, q.j, q.k, q.w
            ));
        }
        text
    }

    /// The KITTI odometry text: twelve numbers a line, the rows of the 3×4 matrix camera to world, without times.
    pub fn to_kitti(&self) -> String {
        let line = |pose: &StampedPose| {
            let matrix = pose.world_from_camera.to_matrix();
            let rows = matrix.fixed_rows::<3>(0).transpose();
            rows.iter().map(|value| format!("{value:.9e}")).collect::<Vec<_>>().join(" ") + "\n"
        };
        self.poses.iter().map(line).collect()
    }

    /// Writes the TUM text to `path`.
    ///
    /// # Errors
    /// [`TrajectoryError::Write`] if the file cannot be written.
    pub fn write_tum(&self, path: &Path) -> Result<(), TrajectoryError> {
        let write_error = |source| TrajectoryError::Write { path: path.into(), source };
        let mut file = std::fs::File::create(path).map_err(write_error)?;
        file.write_all(self.to_tum().as_bytes()).map_err(write_error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Trajectory, TrajectoryError> {
        Trajectory::parse_tum(text, Path::new("poses.txt"))
    }

    #[test]
    fn text_round_trip_keeps_poses() {
        let pose = StampedPose {
            timestamp_s: 1_341_841_278.842_7,
            world_from_camera: super::super::se3::exp(&nalgebra::Vector6::new(1.0, -2.0, 3.0, 0.1, 0.2, -0.3)),
        };
        let back = parse(&Trajectory { poses: vec![pose] }.to_tum()).unwrap().poses[0];
        assert!((back.world_from_camera.inverse() * pose.world_from_camera).translation.vector.norm() < 1e-8);
        assert_eq!(back.timestamp_s, pose.timestamp_s);
    }

    #[test]
    fn files_give_back_what_they_took() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("poses.txt");
        let pose = |timestamp_s| StampedPose { timestamp_s, world_from_camera: Isometry3::translation(1.0, 2.0, 3.0) };
        let trajectory = Trajectory { poses: [0.5, 1.5].map(pose).to_vec() };
        trajectory.write_tum(&path).unwrap();
        assert_eq!(Trajectory::read_tum(&path).unwrap().to_tum(), trajectory.to_tum());
        assert!(Trajectory::read_tum(folder.path()).is_err());
    }

    #[test]
    fn the_nearest_pose_is_found_and_of_two_the_earlier() {
        let pose = |timestamp_s| StampedPose { timestamp_s, world_from_camera: Se3::identity() };
        let trajectory = Trajectory { poses: [0.0, 1.0, 3.0].map(pose).to_vec() };
        let found = [-1.0, -0.5, 0.0, 0.5, 0.75, 1.0, 2.0, 2.25, 3.0, 3.5, 4.0].map(|t| trajectory.nearest(t, 0.75));
        assert_eq!(found, [None, Some(0), Some(0), Some(0), Some(1), Some(1), None, Some(2), Some(2), Some(2), None]);
        assert_eq!(trajectory.nearest(2.0, 1.0), Some(1));
        assert_eq!(Trajectory::default().nearest(0.0, 1.0), None);
    }

    #[test]
    fn errors_name_the_file_and_the_line() {
        let message = |text: &str| parse(text).unwrap_err().to_string();
        assert!(message("# head\n0 0 0 0 0 0 0 1\n1 0 0 NaN 0 0 0 1\n").starts_with("poses.txt:3: `NaN`"));
        assert!(message("0 0 0 0 0 0 1\n").starts_with("poses.txt:1: fewer"));
        assert!(message("0 0 0 0 0 0 0 0\n").contains("no length"));
        assert!(message("0 0 0 0 0 9e-5 0 0\n").contains("no length") && parse("0 0 0 0 0 1e-4 0 0\n").is_ok());
        assert!(message("1 0 0 0 0 0 0 1\n0.5 0 0 0 0 0 0 1\n").contains("sort the file"));
    }
}
