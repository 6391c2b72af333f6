//! Bytes of a container, in order: read ahead as far as needed, passed over, searched.

use std::io::{self, BufRead, Read};

/// Bytes that are read at a time.
const BLOCK: usize = 64 * 1024;

/// A file that says how far it has been read.
pub struct Watched<'a, R> {
    inner: R,
    done: u64,
    total: u64,
    progress: &'a (dyn Fn(u64, u64) + Sync),
}

impl<'a, R: Read> Watched<'a, R> {
    /// A file of which `done` bytes of `total` come before it, in other files.
    pub fn new(inner: R, done: u64, total: u64, progress: &'a (dyn Fn(u64, u64) + Sync)) -> Self {
        Self { inner, done, total, progress }
    }
}

impl<R: Read> Read for Watched<'_, R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.inner.read(buffer)?;
        self.done += read as u64;
        (self.progress)(self.done, self.total);
        Ok(read)
    }
}

/// A reader with a buffer that can be looked into. An error ends it; what was read before is used, and the error is kept.
pub struct Input<R> {
    inner: R,
    buffer: Vec<u8>,
    start: usize,
    position: u64,
    ended: bool,
    error: Option<io::Error>,
}

impl<R: Read> Input<R> {
    pub fn new(inner: R) -> Self {
        Self { inner, buffer: Vec::new(), start: 0, position: 0, ended: false, error: None }
    }

    /// Bytes consumed so far.
    pub fn position(&self) -> u64 {
        self.position
    }

    /// The error that ended it, once.
    pub fn take_error(&mut self) -> Option<io::Error> {
        self.error.take()
    }

    /// What is in the buffer.
    fn buffered(&self) -> &[u8] {
        &self.buffer[self.start..]
    }

    /// The next `count` bytes, or as many as there are. `count` is a small constant or a length checked against one.
    pub fn peek(&mut self, count: usize) -> &[u8] {
        while self.buffered().len() < count && !self.ended {
            self.read_block();
        }
        let available = self.buffered().len().min(count);
        &self.buffered()[..available]
    }

    fn read_block(&mut self) {
        if self.start > 0 {
            self.buffer.drain(..self.start);
            self.start = 0;
        }
        let end = self.buffer.len();
        self.buffer.resize(end + BLOCK, 0);
        let read = loop {
            match self.inner.read(&mut self.buffer[end..]) {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => {
                    self.error = Some(error);
                    break 0;
                }
                Ok(read) => break read,
            }
        };
        self.buffer.truncate(end + read);
        self.ended = read == 0;
    }

    /// Passes over bytes that are in the buffer.
    pub fn advance(&mut self, count: usize) {
        let count = count.min(self.buffered().len());
        self.start += count;
        self.position += count as u64;
    }

    /// Passes over `count` bytes; `false` if there are not as many.
    pub fn skip(&mut self, mut count: u64) -> bool {
        while count > 0 {
            self.peek(1);
            let step = self.buffered().len().min(count.min(1 << 30) as usize);
            if step == 0 {
                return false;
            }
            self.advance(step);
            count -= step as u64;
        }
        true
    }

    /// Passes over all that is left.
    pub fn drain(&mut self) {
        self.skip(u64::MAX);
    }

    /// Takes the next `count` bytes into `bytes`, which grows as they come; `false` if there are not as many.
    pub fn take_into(&mut self, mut count: u64, bytes: &mut Vec<u8>) -> bool {
        bytes.clear();
        while count > 0 {
            self.peek(1);
            let step = self.buffered().len().min(count.min(1 << 30) as usize);
            if step == 0 {
                return false;
            }
            bytes.extend_from_slice(&self.buffered()[..step]);
            self.advance(step);
            count -= step as u64;
        }
        true
    }

    /// Goes on to the first place from here where `found` sees something: it is given bytes and the index in them from where
    /// to look on, and gives the index where what it seeks begins. It looks back `behind` bytes at most and ahead `ahead`
    /// bytes. `false`, at the end, if it sees nothing.
    pub fn search(
        &mut self,
        behind: usize,
        ahead: usize,
        found: impl Fn(&[u8], usize) -> Option<usize>,
    ) -> bool {
        let mut from = 0;
        loop {
            self.peek(BLOCK + ahead);
            let window = self.buffered();
            if let Some(at) = found(window, from) {
                self.advance(at);
                return true;
            }
            if self.ended {
                self.drain();
                return false;
            }
            // Whatever is not whole in this window is so in the next.
            let passed = window.len().saturating_sub(behind + ahead);
            from = window.len().saturating_sub(ahead) - passed;
            self.advance(passed);
        }
    }
}

impl<R: Read> Read for Input<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let mut available = self.fill_buf()?;
        let read = available.read(buffer)?;
        self.advance(read);
        Ok(read)
    }
}

impl<R: Read> BufRead for Input<R> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        self.peek(1);
        Ok(self.buffered())
    }

    fn consume(&mut self, count: usize) {
        self.advance(count);
    }
}
