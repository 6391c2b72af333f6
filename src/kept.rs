//! What a reset does not take: the map with the pose, and the wheels' ticks, in RAM that the start-up code leaves alone.
//!
//! The map is valid where its seal says so: a magic word, the checksum of this firmware's own code and constants (another firmware
//! lays memory out differently), and the checksum of the map itself. While it is worked on it is open, with the seal of
//! its last state; a reset in that time leaves it half done, and it is put in order. RAM that had no power is not believed,
//! whatever its seal says: an open map has no checksum, and half-decayed RAM may have kept the seal and lost the rest.

use core::mem::MaybeUninit;
use core::ptr::{addr_of, addr_of_mut};
use core::sync::atomic::{Ordering, compiler_fence};

use fletcher::calc_fletcher64;
use slam_core::ConfigError;

use crate::lidar::BEAMS;
use crate::robot;

/// Map segments and places there is room for: a whole floor …
#[cfg(not(feature = "small"))]
pub const ROOM: [usize; 2] = [slam_core::capacity::SEGMENTS, slam_core::capacity::PLACES];
/// … or less, on parts with 128 KiB of RAM.
#[cfg(feature = "small")]
pub const ROOM: [usize; 2] = [448, 96];
/// Odometry samples there is room for.
pub const SAMPLES: usize = slam_core::capacity::SAMPLES;

/// The map, the pose and the odometry.
pub type Mapper = slam_core::Mapper<{ ROOM[0] }, SAMPLES, BEAMS, { ROOM[1] }>;

const WORD: usize = size_of::<u32>();
const MAGIC: u32 = 0x4C53_4C4D;
const OPEN: u32 = 0x4F50_454E;
const SEALED: u32 = 0x5345_414C;

/// What happened to the map at start-up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, defmt::Format)]
pub enum Found {
    /// It is as the last run left it.
    Map,
    /// There is none: power-up, or another firmware ran.
    Nothing,
    /// The last run was reset while it worked on the map; what was whole of it is there.
    HalfDone,
    /// Its checksum is wrong.
    Damaged,
    /// Power was away: whatever the checksum says, RAM that had none is not believed.
    PowerWasAway,
    /// The firmware failed early with it too often, running.
    GivenUp,
}

impl Found {
    /// Whether there is a map to go on with.
    pub fn is_map(self) -> bool {
        matches!(self, Self::Map | Self::HalfDone)
    }
}

#[repr(C)]
struct Seal {
    magic: u32,
    open: u32,
    firmware: u64,
    checksum: u64,
}

#[repr(C)]
struct Store {
    seal: MaybeUninit<Seal>,
    mapper: MaybeUninit<Mapper>,
}

#[unsafe(link_section = ".uninit.STORE")]
static mut STORE: Store = Store { seal: MaybeUninit::uninit(), mapper: MaybeUninit::uninit() };

/// The one owner of the kept map.
pub struct Keeper {
    seal: &'static mut Seal,
    mapper: &'static mut Mapper,
}

impl Keeper {
    /// Takes the map that the last run left, or begins a new one, as it does where `refused` says why it is not to be had. To be
    /// called once.
    pub fn take(refused: Option<Found>) -> Result<(Self, Found), ConfigError> {
        let firmware = firmware_checksum();
        let store = addr_of_mut!(STORE);
        // SAFETY: called once, before any task runs, so nothing else refers to the store. A seal is four numbers, of
        // which any bits are valid. The mapper is only taken as one where the seal says that this very firmware left
        // these very bytes there.
        unsafe {
            let seal = (*store).seal.assume_init_mut();
            let mapper = addr_of_mut!((*store).mapper);
            let found = if let Some(why) = refused {
                why
            } else if seal.magic != MAGIC || seal.firmware != firmware {
                Found::Nothing
            } else if seal.open == OPEN {
                Found::HalfDone
            } else if seal.checksum != checksum(mapper) {
                Found::Damaged
            } else {
                Found::Map
            };
            // Half done, it is the mapper of this firmware all the same: each number in it has its old value, its new one
            // or one on the way, and of each of them any bits are valid.
            let found = match found {
                Found::HalfDone if !(*mapper).assume_init_mut().recover() => Found::Damaged,
                other => other,
            };
            if !found.is_map() {
                *seal = Seal { magic: 0, firmware, open: OPEN, checksum: 0 };
                Mapper::new_in(&mut *mapper, robot::config(), robot::DRIVE)?;
            }
            let mut keeper = Self { seal, mapper: (*mapper).assume_init_mut() };
            keeper.update(|_| ());
            Ok((keeper, found))
        }
    }

    /// The map, to look at.
    pub fn mapper(&self) -> &Mapper {
        self.mapper
    }

    /// Begins a new map in place of the one that is kept.
    pub fn forget(&mut self) -> Result<(), ConfigError> {
        self.seal.open = OPEN;
        self.seal.magic = 0;
        compiler_fence(Ordering::SeqCst);
        // SAFETY: the mapper's own place, which nothing else refers to. Nothing is to be dropped in it, and where the
        // configuration is refused, which it was not at the start, it stays as it is.
        let place = unsafe { &mut *core::ptr::from_mut(&mut *self.mapper).cast::<MaybeUninit<Mapper>>() };
        Mapper::new_in(place, robot::config(), robot::DRIVE)?;
        self.update(|_| ());
        Ok(())
    }

    /// Works on the map and seals it again.
    pub fn update<R>(&mut self, work: impl FnOnce(&mut Mapper) -> R) -> R {
        self.seal.open = OPEN;
        compiler_fence(Ordering::SeqCst);
        let result = work(self.mapper);
        compiler_fence(Ordering::SeqCst);
        // SAFETY: the mapper is initialised, and nothing else refers to it now.
        self.seal.checksum = unsafe { checksum(core::ptr::from_mut(self.mapper).cast()) };
        self.seal.magic = MAGIC;
        compiler_fence(Ordering::SeqCst);
        self.seal.open = SEALED;
        result
    }
}

/// Checksum of the store's mapper, padding included.
///
/// # Safety
/// `mapper` must point to the store's mapper, which nothing may write meanwhile. Its bytes may be whatever power-up left:
/// they lie in RAM that has been there all along, so that each has a value, and the black box keeps the compiler from
/// thinking otherwise.
unsafe fn checksum(mapper: *const MaybeUninit<Mapper>) -> u64 {
    const { assert!(align_of::<Mapper>() >= align_of::<u32>() && Mapper::BYTES.is_multiple_of(WORD)) };
    let words = core::hint::black_box(mapper.cast::<u32>());
    // SAFETY: these are the mapper's words.
    calc_fletcher64(unsafe { core::slice::from_raw_parts(words, Mapper::BYTES / WORD) })
}

/// Checksum of this firmware's code and constants, which lie side by side.
fn firmware_checksum() -> u64 {
    unsafe extern "C" {
        static __stext: u32;
        static __erodata: u32;
    }
    let (from, to) = (addr_of!(__stext), addr_of!(__erodata));
    // SAFETY: the linker puts code and constants between these two, at whole words, and nobody writes them.
    let code = unsafe { core::slice::from_raw_parts(from, (to.addr() - from.addr()) / WORD) };
    calc_fletcher64(code)
}

/// The wheels' ticks, twice, so that a reset while one is written leaves the other.
#[repr(C)]
#[derive(Clone, Copy)]
struct TickSlot {
    order: u32,
    totals: [i32; 2],
    check: u32,
}

impl TickSlot {
    fn check(&self) -> u32 {
        let [left, right] = self.totals;
        MAGIC ^ self.order.rotate_left(7) ^ (left as u32).rotate_left(13) ^ (right as u32).rotate_left(23)
    }
}

#[unsafe(link_section = ".uninit.TICKS")]
static mut TICKS: MaybeUninit<[TickSlot; 2]> = MaybeUninit::uninit();

/// The one owner of the kept ticks.
pub struct KeptTicks {
    slots: &'static mut [TickSlot; 2],
}

impl KeptTicks {
    /// Takes them. To be called once; `afresh` where there is no map that they belong to.
    pub fn take(afresh: bool) -> Self {
        // SAFETY: called once, before any task runs, so nothing else refers to them; any bits are valid numbers.
        let slots = unsafe { (*addr_of_mut!(TICKS)).assume_init_mut() };
        if afresh {
            for slot in slots.iter_mut() {
                *slot = TickSlot { order: 0, totals: [0; 2], check: 0 };
                slot.check = slot.check();
            }
        }
        Self { slots }
    }

    /// The newest that is whole; zero without any.
    pub fn read(&self) -> [i32; 2] {
        let whole = self.slots.iter().filter(|slot| slot.check == slot.check());
        whole.max_by_key(|slot| slot.order).map_or([0; 2], |slot| slot.totals)
    }

    /// Keeps new ones, in place of the older.
    pub fn write(&mut self, totals: [i32; 2]) {
        let newest = self.slots.iter().filter(|s| s.check == s.check()).map(|s| s.order).max().unwrap_or(0);
        let order = newest.wrapping_add(1);
        if let Some(slot) = self.slots.get_mut(order as usize % 2) {
            slot.check = !slot.check;
            compiler_fence(Ordering::SeqCst);
            (slot.order, slot.totals) = (order, totals);
            compiler_fence(Ordering::SeqCst);
            slot.check = slot.check();
        }
    }
}
