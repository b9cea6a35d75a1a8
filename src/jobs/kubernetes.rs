//! A plan as an Indexed Job of Kubernetes: text to be applied by `kubectl`. Nothing is sent from here.

use super::{AGAIN, NEVER_AGAIN, Plan};

/// Processes that may end by themselves before an index has failed.
const RETRIES: usize = 3;
/// Seconds for a checkpoint between SIGTERM and SIGKILL.
const GRACE_S: usize = 120;

/// The Job in YAML. Its pods run one task each; status 75 and evictions do not count as failures, status 65 fails the index at once.
pub fn to_yaml(plan: &Plan) -> String {
    let tasks = plan.tasks.len();
    format!(
        r#"# Before `kubectl apply -f`: fill in the image and the volume claim. The plan and its inputs must have the paths that they have here.
# Afterwards: keysplat jobs merge {folder}
apiVersion: batch/v1
kind: Job
metadata:
  name: keysplat
spec:
  completionMode: Indexed
  completions: {tasks}
  parallelism: {tasks}
  backoffLimitPerIndex: {RETRIES}
  maxFailedIndexes: {tasks}
  podFailurePolicy:
    rules:
      - action: FailIndex
        onExitCodes:
          containerName: task
          operator: In
          values: [{NEVER_AGAIN}]
      - action: Ignore
        onExitCodes:
          containerName: task
          operator: In
          values: [{AGAIN}]
      - action: Ignore
        onPodConditions:
          - type: DisruptionTarget
            status: "True"
  template:
    spec:
      restartPolicy: Never
      terminationGracePeriodSeconds: {GRACE_S}
      containers:
        - name: task
          image: registry.example.com/keysplat:{version}
          command: ["keysplat", "jobs", "run", {folder:?}, "--task", "$(JOB_COMPLETION_INDEX)"]
          resources:
            limits:
              nvidia.com/gpu: 1
          volumeMounts:
            - name: plan
              mountPath: {mount:?}
      volumes:
        - name: plan
          persistentVolumeClaim:
            claimName: keysplat
"#,
        version = env!("CARGO_PKG_VERSION"),
        folder = plan.folder().to_string_lossy(),
        mount = plan.folder().parent().unwrap_or(plan.folder()).to_string_lossy(),
    )
}
