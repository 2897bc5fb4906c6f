//! A program that holds stdin open as a pipe, and ends the command with its own end.

use std::future::pending;
use std::os::fd::AsFd;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use tokio::io::AsyncReadExt;
use tokio::net::unix::pipe;

/// True if stdin is a pipe that no process writes to.
pub fn is_closed() -> bool {
    let stdin = std::io::stdin();
    let mut asked = [PollFd::new(stdin.as_fd(), PollFlags::empty())];
    let is_answered = poll(&mut asked, PollTimeout::ZERO).is_ok();
    is_answered && asked[0].revents().is_some_and(|events| events.contains(PollFlags::POLLHUP))
}

/// Returns when the pipe that is stdin is closed, if that `ends` the command; never if stdin is no pipe.
pub async fn closed(ends: bool) {
    let stdin = pipe::OpenOptions::new().open_receiver("/dev/stdin").ok().filter(|_| ends);
    let Some(mut stdin) = stdin else { return pending().await };
    let mut ignored = [0; 64];
    while matches!(stdin.read(&mut ignored).await, Ok(1..)) {}
}
