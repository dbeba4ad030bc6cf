// What becomes of memory that is given back.
#pragma once

namespace vlgs {

// While on, the C library keeps what is freed for whoever asks next. By itself it returns blocks above 32 MiB
// to the system at once, and the system clears every page again for the next: maps of hundreds of channels
// come and go in each step of a training. More than 512 MiB at the end of the heap are returned nevertheless.
// Off returns what is free by then, and from then on such blocks as they are freed. Does nothing where there
// is no glibc.
void keep_freed_memory(bool on);

}  // namespace vlgs
