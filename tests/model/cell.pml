/* One master and two drives on a CAN bus, with at most two faults: NMT × CiA 402 × heartbeat × supervision.

   A round is a SYNC with its answers. What is shown, in every order of events:
     listening   power is never on for more than PATIENCE rounds without SYNCs, nor of a drive that the master has not heard
                 for as long, a stop, and the drive's own PATIENCE
     known       a drive takes a target only where the master has read its position since the drive's last boot-up
     together    no joint moves on while another drive is late
     ends        after a loss power ends, or nothing moves, within a bounded number of rounds
   NO_PATIENCE, OLD_POSITION, NO_HOLD and NO_STOP each leave one rule out, and one of these properties then fails. */

#define NODES    2
#define PATIENCE 3 /* arm.missed_syncs, rounds; fewer than in a cell, for a smaller model */
#define LATE     1 /* rounds without a TPDO after which nothing moves on */
#define TRIES    2 /* rounds in which a command of the master is repeated */

mtype:nmt    = { pre_operational, operational }
mtype:phase  = { listen, reset, configure, start, rest, enable, scan, stop, gone }

mtype:nmt nmt[NODES] = pre_operational
bool powered[NODES], configured[NODES]
bool mute[NODES], deaf[NODES] /* frames of the node, and to it, are lost */
bool cut                      /* the bus is lost for all */
bool booted[NODES]            /* a boot-up that the master has not read */
bool fresh[NODES]             /* the master has read the position of this boot */
byte unheard[NODES]           /* rounds since the master heard the node */
byte without[NODES]           /* rounds since the node heard a SYNC */
byte faults, tries, since     /* since: rounds with power on and motion behind a loss */
bool sync, moves, lost
mtype:phase phase = gone
byte i

#define UNHEARD  (PATIENCE + TRIES + 1 + PATIENCE)

#define up(n)   (!cut && !mute[n])
#define down(n) (!cut && !deaf[n])
#define both(p) (p(0) && p(1))
#define heard(n) (unheard[n] == 0)
#define is_operational(n) (heard(n) && nmt[n] == operational)
#define is_powered(n) (heard(n) && powered[n])
#define is_off(n) (heard(n) && !powered[n])
#define is_configured(n) (up(n) && down(n) && configured[n])
#ifdef OLD_POSITION
#define is_known(n) true
#else
#define is_known(n) (fresh[n])
#endif
#define next(p) phase = p; tries = 0
#define each(body) for (i : 0 .. NODES - 1) { body }

inline reboot(n) {
    nmt[n] = pre_operational; powered[n] = false; configured[n] = false
    booted[n] = true; fresh[n] = false
}

inline fault() { /* one of them, or none; a lost link may come back */
    if
    :: true
    :: faults < 2 -> faults++; lost = true
        if
        :: reboot(0)                        /* its power failed, or somebody reset it */
        :: powered[1] = false               /* a fault of the drive itself */
        :: mute[0] = true
        :: deaf[1] = true
        :: cut = true
        :: phase = gone                     /* the master is killed */
        :: !cut && deaf[0] == false -> nmt[0] = pre_operational /* a foreign NMT command */
        fi
    :: mute[0] -> mute[0] = false
    :: deaf[1] -> deaf[1] = false
    :: cut -> cut = false
    fi
}

inline lose() {
#ifdef NO_STOP
    skip
#else
    next(stop)
#endif
}

inline command() { /* what the master sends in this round */
    sync = false; moves = false
    if
    :: phase == gone -> if :: true :: next(listen) fi /* a new session */
    :: phase == listen -> next(reset)
    :: phase == reset ->
        each(if :: down(i) -> reboot(i) :: else fi; fresh[i] = false)
        next(configure)
    :: phase == configure ->
        each(if :: up(i) && down(i) -> configured[i] = true :: else fi; booted[i] = false)
        if :: both(is_configured) -> next(start) :: else -> next(stop) fi
    :: phase == start ->
        each(if :: down(i) && configured[i] -> nmt[i] = operational :: else fi)
        if :: both(is_operational) -> next(rest) :: tries >= TRIES -> next(stop) :: else -> tries++ fi
    :: phase == rest -> sync = true
        if :: both(is_known) -> next(enable) :: tries >= TRIES -> next(stop) :: else -> tries++ fi
    :: phase == enable -> sync = true
        each(if :: down(i) && nmt[i] == operational ->
                    assert(fresh[i]); /* known: the first target is the position of this boot */
                    powered[i] = true
                :: else fi)
        if :: both(is_powered) -> next(scan) :: tries >= TRIES -> next(stop) :: else -> tries++ fi
    :: phase == scan -> sync = true
#ifdef NO_HOLD
        moves = true
#else
        moves = unheard[0] < LATE && unheard[1] < LATE
#endif
    :: phase == stop -> sync = true
        each(if :: down(i) -> powered[i] = false :: else fi)
        if
        :: both(is_off) || tries >= TRIES -> each(if :: down(i) -> nmt[i] = pre_operational :: else fi); next(gone)
        :: else -> tries++
        fi
    fi
}

inline drive(n) { /* what a node does by itself */
    if
    :: sync && down(n) && nmt[n] == operational -> without[n] = 0
    :: else -> if :: without[n] <= PATIENCE -> without[n]++ :: else fi
    fi
#ifndef NO_PATIENCE
    if :: without[n] > PATIENCE -> powered[n] = false :: else fi
#endif
}

inline supervise(n) {
    if
    :: up(n) && (sync && down(n) && nmt[n] == operational || phase == start || phase == configure) ->
        unheard[n] = 0
        if :: sync && down(n) && nmt[n] == operational -> fresh[n] = true :: else fi
    :: else -> if :: unheard[n] <= UNHEARD -> unheard[n]++ :: else fi
    fi
    if
    :: (phase == enable || phase == scan) && (unheard[n] > PATIENCE || up(n) && booted[n]) -> lose()
    :: phase == scan && heard(n) && (!powered[n] || nmt[n] != operational) -> lose()
    :: else
    fi
}

active proctype cell() {
    do
    :: atomic {
        fault(); command(); drive(0); drive(1); supervise(0); supervise(1)
        each(assert(!powered[i] || without[i] <= PATIENCE)) /* listening */
        each(assert(!powered[i] || unheard[i] <= UNHEARD)) /* listening, the other way */
        assert(!moves || unheard[0] <= LATE && unheard[1] <= LATE) /* together */
        if
        :: lost && moves && !(heard(0) && heard(1) && powered[0] && powered[1]) -> since++
        :: else -> since = 0
        fi
        assert(since <= PATIENCE + TRIES) /* ends */
#ifdef REACHED
        if :: faults == 2 -> assert(!(phase == scan && moves)) :: else fi
#endif
        if :: faults == 2 && !mute[0] && !deaf[1] && !cut && phase == gone -> lost = false :: else fi
       }
    od
}
