/* Driver of CANopenNode for a bus that is a pipe. One thread: nothing needs a lock. */
#ifndef CO_DRIVER_TARGET_H
#define CO_DRIVER_TARGET_H
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define CO_CONFIG_EM                                                                                                   \
    (CO_CONFIG_EM_PRODUCER | CO_CONFIG_EM_PROD_CONFIGURABLE | CO_CONFIG_EM_PROD_INHIBIT | CO_CONFIG_EM_HISTORY)
#define CO_CONFIG_SDO_CLI (0)
#define CO_CONFIG_LSS (CO_CONFIG_LSS_SLAVE | CO_CONFIG_LSS_SLAVE_FASTSCAN_DIRECT_RESPOND)
#define CO_CONFIG_GTW (0)
#define CO_CONFIG_FIFO (CO_CONFIG_FIFO_ENABLE | CO_CONFIG_FIFO_ALT_READ | CO_CONFIG_FIFO_CRC16_CCITT)
#define CO_CONFIG_SDO_SRV (CO_CONFIG_SDO_SRV_SEGMENTED | CO_CONFIG_SDO_SRV_BLOCK)
#define CO_CONFIG_SDO_SRV_BUFFER_SIZE 900
#define CO_CONFIG_CRC16 (CO_CONFIG_CRC16_ENABLE)
#define CO_LITTLE_ENDIAN
#define CO_SWAP_16(x) x
#define CO_SWAP_32(x) x
#define CO_SWAP_64(x) x

typedef uint_fast8_t bool_t;
typedef float float32_t;
typedef double float64_t;
typedef struct {
    uint32_t ident;
    uint8_t DLC;
    uint8_t data[8];
} CO_CANrxMsg_t;
#define CO_CANrxMsg_readIdent(msg) ((uint16_t)(((CO_CANrxMsg_t*)(msg))->ident & 0x7FF))
#define CO_CANrxMsg_readDLC(msg) (((CO_CANrxMsg_t*)(msg))->DLC)
#define CO_CANrxMsg_readData(msg) (((CO_CANrxMsg_t*)(msg))->data)
typedef struct {
    uint16_t ident, mask;
    void* object;
    void (*CANrx_callback)(void* object, void* message);
} CO_CANrx_t;
typedef struct {
    uint32_t ident;
    uint8_t DLC;
    uint8_t data[8];
    volatile bool_t bufferFull, syncFlag;
} CO_CANtx_t;
typedef struct {
    void* CANptr;
    CO_CANrx_t* rxArray;
    uint16_t rxSize;
    CO_CANtx_t* txArray;
    uint16_t txSize, CANerrorStatus;
    volatile bool_t CANnormal, useCANrxFilters, bufferInhibitFlag, firstCANtxMessage;
    volatile uint16_t CANtxCount;
    uint32_t errOld;
} CO_CANmodule_t;
typedef struct {
    void* addr;
    size_t len;
    uint8_t subIndexOD, attr;
    void* addrNV;
} CO_storage_entry_t;

#define CO_LOCK_CAN_SEND(module)
#define CO_UNLOCK_CAN_SEND(module)
#define CO_LOCK_EMCY(module)
#define CO_UNLOCK_EMCY(module)
#define CO_LOCK_OD(module)
#define CO_UNLOCK_OD(module)
#define CO_MemoryBarrier()
#define CO_FLAG_READ(flag) ((flag) != NULL)
#define CO_FLAG_SET(flag)                                                                                              \
    { flag = (void*)1L; }
#define CO_FLAG_CLEAR(flag)                                                                                            \
    { flag = NULL; }
#endif
