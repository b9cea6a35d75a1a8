//! Keys in the terminal that steer a run: space pauses and goes on, `n` steps, `r` refines on, `q` finishes.

#[cfg(unix)]
pub use unix::Keys;

/// A key that was pressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Key {
    /// Pause, or go on.
    Pause,
    /// One more keyframe or round.
    Step,
    /// Refine beyond the end.
    Refine,
    /// End the run with what there is.
    Finish,
}

impl Key {
    /// The key of a byte; others mean nothing.
    fn of(byte: u8) -> Option<Self> {
        match byte {
            b' ' | b'p' => Some(Self::Pause),
            b'n' => Some(Self::Step),
            b'r' => Some(Self::Refine),
            b'q' => Some(Self::Finish),
            _ => None,
        }
    }
}

/// Does what a key means.
pub fn steer(key: Key, progress: &keysplat::Progress) {
    let control = progress.control();
    match key {
        Key::Pause if control.is_paused() => control.resume(),
        Key::Pause => control.pause(),
        Key::Step => control.step(),
        Key::Refine => control.refine_on(!control.refines_on()),
        Key::Finish => control.stop(),
    }
}

#[cfg(unix)]
mod unix {
    use std::io::IsTerminal;
    use std::sync::Mutex;
    use std::time::Duration;

    use rustix::event::{PollFd, PollFlags, Timespec, poll};
    use rustix::process::getpgrp;
    use rustix::stdio::stdin;
    use rustix::termios::{LocalModes, OptionalActions, Termios, tcgetattr, tcgetpgrp, tcsetattr};

    use super::Key;

    /// The terminal's settings before, to be put back whatever way the program ends.
    static BEFORE: Mutex<Option<Termios>> = Mutex::new(None);

    /// The terminal gives each key at once, without an echo, while this lives.
    pub struct Keys;

    impl Keys {
        /// `None` where nobody sits at a terminal.
        pub fn listen() -> Option<Self> {
            if !std::io::stdin().is_terminal() || !std::io::stderr().is_terminal() || !is_in_foreground() {
                return None;
            }
            let before = tcgetattr(stdin()).ok()?;
            let mut at_once = before.clone();
            at_once.local_modes.remove(LocalModes::ICANON | LocalModes::ECHO);
            tcsetattr(stdin(), OptionalActions::Now, &at_once).ok()?;
            *BEFORE.lock().ok()? = Some(before);
            Some(Self)
        }

        /// Waits so long for a key.
        pub fn wait(&self, time: Duration) -> Option<Key> {
            let time = Timespec { tv_sec: time.as_secs() as i64, tv_nsec: i64::from(time.subsec_nanos()) };
            let input = stdin();
            let mut ready = [PollFd::new(&input, PollFlags::IN)];
            let is_there = poll(&mut ready, Some(&time)).is_ok_and(|count| count > 0) && is_in_foreground();
            let mut byte = [0u8];
            let count = if is_there { rustix::io::read(stdin(), &mut byte).unwrap_or(0) } else { 0 };
            (count > 0).then_some(byte[0]).and_then(Key::of)
        }

        /// Puts the terminal back as it was.
        pub fn restore() {
            if let Ok(mut before) = BEFORE.lock()
                && let Some(before) = before.take()
                && is_in_foreground()
            {
                let _ = tcsetattr(stdin(), OptionalActions::Now, &before);
            }
        }
    }

    /// Whether the terminal is ours: it stops whoever reads or sets it from the background.
    fn is_in_foreground() -> bool {
        tcgetpgrp(stdin()).is_ok_and(|group| group == getpgrp())
    }

    impl Drop for Keys {
        fn drop(&mut self) {
            Self::restore();
        }
    }
}

/// Without a terminal as Unix has it, there are no keys.
#[cfg(not(unix))]
pub struct Keys;

#[cfg(not(unix))]
impl Keys {
    /// None here.
    pub fn listen() -> Option<Self> {
        None
    }

    /// Waits.
    pub fn wait(&self, time: std::time::Duration) -> Option<Key> {
        std::thread::sleep(time);
        None
    }

    /// Nothing to put back.
    pub fn restore() {}
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_steer_a_run() {
        let progress = keysplat::Progress::default();
        let press = |byte: u8| Key::of(byte).map(|key| steer(key, &progress));
        assert!(press(b'x').is_none() && press(b' ').is_some() && progress.control().is_paused());
        press(b'n');
        assert!(!progress.control().is_paused());
        press(b'r');
        assert!(progress.control().refines_on());
        press(b'r');
        press(b'q');
        assert!(!progress.control().refines_on() && progress.stopped());
    }
}
